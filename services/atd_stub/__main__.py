"""Run with `python -m sonarpost.services.atd_stub --config FILE`."""

from sonarpost.runtime.process import main
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.service import AtdStubService
from sonarpost.stop_signals import exit_process

if __name__ == "__main__":
    exit_process(main(AtdStubService, AtdStubConfig))
