"""The operator's console: see it, decide, ask for more."""
