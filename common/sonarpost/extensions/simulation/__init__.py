"""Simulation of what sonarpost needs at sea: modems, the acoustic channel, and side-scan surveys of the seabed."""
