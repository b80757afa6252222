"""Run with `python -m services.console --config FILE`."""

import sys

from services.console.config import ConsoleConfig
from services.console.service import ConsoleService
from sonarpost.runtime.process import main


def run() -> int:
    """Run the service until it is told to stop; return the exit status."""
    return main(ConsoleService, ConsoleConfig)


if __name__ == "__main__":
    sys.exit(run())
