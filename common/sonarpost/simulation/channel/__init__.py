"""The simulated acoustic channel: propagation, loss, fading, and its event log."""
