"""The simulated world: seabed and survey, water, emulated modems."""
