"""Run with `python -m sonarpost.services.op_modem --config FILE`."""

from sonarpost.runtime.process import main
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService
from sonarpost.stop_signals import exit_process

if __name__ == "__main__":
    exit_process(main(OpModemService, OpModemConfig))
