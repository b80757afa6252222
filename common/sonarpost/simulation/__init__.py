"""Simulation: Micro-Modems, the acoustic channel, the seabed with its survey, and missions."""
