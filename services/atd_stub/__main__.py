"""Run with `python -m services.atd_stub --config FILE`."""

import sys

from services.atd_stub.config import AtdStubConfig
from services.atd_stub.service import AtdStubService
from sonarpost.runtime.process import main


def run() -> int:
    """Run the service until it is told to stop; return the exit status."""
    return main(AtdStubService, AtdStubConfig)


if __name__ == "__main__":
    sys.exit(run())
