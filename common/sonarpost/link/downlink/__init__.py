"""Commands, decisions and other messages from the vessel to vehicles, and their confirmations."""
