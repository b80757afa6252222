"""sonarpost: side-scan-sonar snippets from an underwater vehicle, through an acoustic modem, to ship and shore."""

__version__ = "0.1.0"
