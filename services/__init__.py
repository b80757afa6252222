"""One folder a process; run as python -m services.<name> --config FILE."""
