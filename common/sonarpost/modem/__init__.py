"""Acoustic modem drivers, as pure state machines."""
