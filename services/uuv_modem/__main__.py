"""Run with `python -m services.uuv_modem --config FILE`."""

import sys

from services.uuv_modem.config import UuvModemConfig
from services.uuv_modem.service import UuvModemService
from sonarpost.runtime.process import main


def run() -> int:
    """Run the service until it is told to stop; return the exit status."""
    return main(UuvModemService, UuvModemConfig)


if __name__ == "__main__":
    sys.exit(run())
