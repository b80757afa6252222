"""Run with `python -m sonarpost.services.atd_stub --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.service import AtdStubService

if __name__ == "__main__":
    sys.exit(main(AtdStubService, AtdStubConfig))
