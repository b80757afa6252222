"""Run with `python -m sonarpost.services.uuv_modem --config FILE`."""

from sonarpost.runtime.process import main
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService
from sonarpost.stop_signals import exit_process

if __name__ == "__main__":
    exit_process(main(UuvModemService, UuvModemConfig))
