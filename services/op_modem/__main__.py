"""Run with `python -m services.op_modem --config FILE`."""

import sys

from services.op_modem.config import OpModemConfig
from services.op_modem.service import OpModemService
from sonarpost.runtime.process import main


def run() -> int:
    """Run the service until it is told to stop; return the exit status."""
    return main(OpModemService, OpModemConfig)


if __name__ == "__main__":
    sys.exit(run())
