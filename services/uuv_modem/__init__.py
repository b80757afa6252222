"""The vehicle side of the acoustic link."""
