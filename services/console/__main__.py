"""Run with `python -m sonarpost.services.console --config FILE`."""

from sonarpost.runtime.process import main
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.service import ConsoleService
from sonarpost.stop_signals import exit_process

if __name__ == "__main__":
    exit_process(main(ConsoleService, ConsoleConfig))
