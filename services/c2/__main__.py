"""Run with `python -m services.c2 --config FILE`."""

import sys

from services.c2.config import C2Config
from services.c2.service import C2Service
from sonarpost.runtime.process import main


def run() -> int:
    """Run the service until it is told to stop; return the exit status."""
    return main(C2Service, C2Config)


if __name__ == "__main__":
    sys.exit(run())
