"""Run with `python -m sonarpost.services.c2 --config FILE`."""

from sonarpost.runtime.process import main
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.stop_signals import exit_process

if __name__ == "__main__":
    exit_process(main(C2Service, C2Config))
