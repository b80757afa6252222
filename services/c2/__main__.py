"""Run with `python -m sonarpost.services.c2 --config FILE`."""

import sys

from sonarpost.runtime.process import main
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

if __name__ == "__main__":
    sys.exit(main(C2Service, C2Config))
