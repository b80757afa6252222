"""Run with `python -m sonarpost.services.relay --config FILE`."""

from sonarpost.runtime.process import main
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService
from sonarpost.stop_signals import exit_process

if __name__ == "__main__":
    exit_process(main(RelayService, RelayConfig))
