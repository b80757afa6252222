"""Run with `python -m sonarpost.services.uuv_modem --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService

if __name__ == "__main__":
    sys.exit(main(UuvModemService, UuvModemConfig))
