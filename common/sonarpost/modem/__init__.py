"""NMEA sentences and the Micro-Modem driver, as pure state machines."""
