"""A driver of another distribution, and an object that is none."""

from dataclasses import replace

from sonarpost.modem.micromodem.driver import DRIVER

OTHER = replace(DRIVER, name="other")
BROKEN = "not a driver"
