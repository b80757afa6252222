"""Driver of the EvoLogics S2C modems: instant messages and burst data through their AT commands."""
