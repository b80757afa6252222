"""Run with `python -m sonarpost.services.uuv_modem --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService


def run() -> int:
    """Run the service until it is stopped; return the exit status."""
    return main(UuvModemService, UuvModemConfig)


if __name__ == "__main__":
    sys.exit(run())
