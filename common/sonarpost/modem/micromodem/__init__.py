"""Driver of the WHOI Micro-Modem: NMEA sentences and pure state machines."""
