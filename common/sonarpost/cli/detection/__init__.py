"""The `sonarpost detect` command: contacts of survey files."""
