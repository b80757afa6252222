"""One folder a process; run as python -m sonarpost.services.<name> --config FILE."""
