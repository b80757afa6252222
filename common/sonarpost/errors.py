"""Exceptions of sonarpost.

External input (a file, a serial line, an acoustic frame, a Zenoh payload, a configuration) either parses or raises one
of these errors. The message has the form `where: field: got X, expected Y`: the log line alone shows what to correct.
"""

import errno

from typing_extensions import override


class SonarpostError(Exception):
    """Base class of all exceptions of sonarpost."""


class BadInputError(SonarpostError):
    """External input is invalid.

    Args:
        where: Source of the input: a file, key expression, port or frame.
        field: Invalid part of it; empty if the input as a whole is invalid.
        value: Value found there; the message shortens a long one.
        expected: Description of a valid value.
    """

    def __init__(self, where: str, field: str, value: object, expected: str) -> None:
        self.where = where
        self.field = field
        self.value = value
        self.expected = expected
        super().__init__(where, field, value, expected)

    @override
    def __str__(self) -> str:
        shown = repr(self.value)
        if len(shown) > 80:
            shown = f"{shown[:40]}...{shown[-37:]}"  # the end of a path identifies it better than the start
        field = f"{self.field}: " if self.field else ""
        return f"{self.where}: {field}got {shown}, expected {self.expected}"


class SurveyFileError(BadInputError):
    """A survey file or an image file cannot be read."""


class PayloadError(BadInputError):
    """A Zenoh payload is not a valid record of its key."""


class MissingBaseError(PayloadError):
    """A record is the difference to a version that its consumer does not have; its producer sends the whole."""


class StreamError(BadInputError):
    """A codec stream (an encoded image) cannot be decoded."""


class FrameError(BadInputError):
    """An acoustic frame does not match the wire format in use."""


class SentenceError(BadInputError):
    """A line from the modem's serial port is not a valid NMEA sentence."""


class ConfigError(BadInputError):
    """A configuration file or an environment override is invalid."""


class CodebookError(BadInputError):
    """A tile codebook cannot be read, or differs from the one that the encoder used."""


class MissingCodebookError(CodebookError):
    """The codebook that a stream requires is not known here.

    Attributes:
        model: First 32 hexadecimal digits of its identity; empty if only the tag in the stream is known.
    """

    def __init__(self, where: str, model: str, tag: int, known: str) -> None:
        super().__init__(where, "model_tag", f"{tag:#06x} {model}".strip(), f"a known codebook: {known}")
        self.model = model


class StoredFileError(BadInputError):
    """A record file of c2 cannot be read, or does not match its name."""


class QueryRefusedError(SonarpostError):
    """c2 does not accept a query; the text is its error reply."""


class PortError(SonarpostError):
    """A serial port or socket cannot be opened, or was lost."""


class TransmissionError(SonarpostError):
    """A modem did not transmit a packet."""


class DeliveryError(SonarpostError):
    """A record cannot be stored or delivered, for example because of a full disk or a damaged database."""


class RetryLaterError(DeliveryError):
    """A record cannot be accepted at present; its sender keeps it and retries, other records are not affected."""


class DatabaseUnavailableError(DeliveryError):
    """The database server of a shore site is not reached, or rejects a statement; the caller retries."""


class RejectedByDatabaseError(DatabaseUnavailableError):
    """The database server, or an SQLite file, rejects a value of a statement."""


_ERRNO_OF_RECORD = frozenset({errno.ENAMETOOLONG, errno.EINVAL, errno.EILSEQ, errno.EISDIR, errno.ENOTDIR, errno.ELOOP})


def can_concern_record(error: Exception) -> bool:
    """Return whether an error can be caused by the record that is handled, not only by the machine or the network."""
    if isinstance(error, OSError):
        return error.errno in _ERRNO_OF_RECORD
    return isinstance(error, RejectedByDatabaseError) or not isinstance(error, (DeliveryError, MemoryError))
