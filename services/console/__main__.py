"""Run with `python -m sonarpost.services.console --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.service import ConsoleService

if __name__ == "__main__":
    sys.exit(main(ConsoleService, ConsoleConfig))
