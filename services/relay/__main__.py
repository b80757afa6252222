"""Run with `python -m services.relay --config FILE`."""

import sys

from services.relay.config import RelayConfig
from services.relay.service import RelayService
from sonarpost.runtime.process import main


def run() -> int:
    """Run the service until it is told to stop; return the exit status."""
    return main(RelayService, RelayConfig)


if __name__ == "__main__":
    sys.exit(run())
