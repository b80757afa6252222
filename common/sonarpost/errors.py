"""The one tree of errors that sonarpost raises.

Whatever comes from outside (a file, a serial line, an acoustic frame, a Zenoh payload, a configuration) either
parses or raises one of the errors below. The message always names where (file or key), which field, the value that
was met and what was expected, so that a person can act on the log line alone.
"""

from __future__ import annotations


class SonarpostError(Exception):
    """Base of every error that sonarpost raises on purpose."""


class BadInputError(SonarpostError):
    """Something from outside does not parse.

    Args:
        where: The file, key expression, port or frame the input came from.
        field: The part of it that is wrong, or an empty string when the whole is.
        value: What was met there (shortened when long).
        expected: What would have been accepted.
    """

    def __init__(self, where: str, field: str, value: object, expected: str) -> None:
        self.where = where
        self.field = field
        self.value = value
        self.expected = expected
        super().__init__(where, field, value, expected)

    def __str__(self) -> str:
        shown = repr(self.value)
        if len(shown) > 80:
            shown = f"{shown[:40]}...{shown[-37:]}"  # of a path, the end tells more than the beginning
        field = f"{self.field}: " if self.field else ""
        return f"{self.where}: {field}got {shown}, expected {self.expected}"


class SurveyFileError(BadInputError):
    """A survey file or an image file cannot be read."""


class PayloadError(BadInputError):
    """A Zenoh payload is not the record its key promises."""


class StreamError(BadInputError):
    """A codec stream (an encoded image) cannot be decoded."""


class FrameError(BadInputError):
    """An acoustic frame is not of the wire format in use."""


class SentenceError(BadInputError):
    """A line from the modem's serial port is not a valid NMEA sentence."""


class ConfigError(BadInputError):
    """A configuration file or an environment override is wrong."""


class CodebookError(BadInputError):
    """A tile codebook cannot be read, or is not the one the other end used."""


class StoredFileError(BadInputError):
    """A record that c2 keeps as a file cannot be read back, or is not what its place promises."""


class PortError(SonarpostError):
    """A serial port or socket cannot be opened, or went away."""


class DeliveryError(SonarpostError):
    """The durable store refused a record (full disk, damaged database)."""
