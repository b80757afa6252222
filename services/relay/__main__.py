"""Run with `python -m sonarpost.services.relay --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

if __name__ == "__main__":
    sys.exit(main(RelayService, RelayConfig))
