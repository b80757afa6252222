"""The sonarpost command."""
