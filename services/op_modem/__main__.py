"""Run with `python -m sonarpost.services.op_modem --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService

if __name__ == "__main__":
    sys.exit(main(OpModemService, OpModemConfig))
