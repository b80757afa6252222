"""MCAP files of Zenoh records (https://mcap.dev/spec), one channel for each key and encoding.

Payloads are stored as they are. A channel of a sonarpost record has the message encoding `msgpack` and the JSON schema
of the record. Derived channels for Foxglove have topics that are no keys of sonarpost; the reader skips them.
"""

import io
import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

import lz4.frame
import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from sonarpost import keys, messages, wire
from sonarpost.errors import BadInputError
from sonarpost.extensions.mcap.foxglove import SCHEMAS
from sonarpost.messages import Record

MAX_RECORD_BYTES: Final = 64 << 20
"""Largest record and largest decompressed chunk that the reader accepts."""
MAX_CHANNELS: Final = 10_000
"""Channels of one recording or file."""
CHUNK_BYTES: Final = 16 << 10
"""A chunk is written when it is larger: a crash loses less than this, or one record."""
PART_BYTES: Final = 1 << 30
"""Size at which a recording continues in a new file. It bounds the index in memory."""

# A length of 64 bits in a damaged record does not fit into an index; lz4 raises RuntimeError.
_DAMAGE: Final = (McapError, zstandard.ZstdError, RuntimeError, ValueError, OverflowError, struct.error, EOFError)
_MAGIC: Final = b"\x89MCAP0\r\n"
_ENCODING: Final = "zenoh_encoding"
_RECORDS: Final[Mapping[str, type[Record]]] = {
    wire.encoding_of(t): t for t in vars(messages).values() if isinstance(t, type) and issubclass(t, Record) and t.TYPE
}


class McapFileError(BadInputError):
    """An MCAP file cannot be read, or is incomplete."""


class McapRecording:
    """Writes records into an MCAP file, and into further files `NAME.0002.mcap`, … after `PART_BYTES`.

    Args:
        path: The first file; it must not exist.

    Raises:
        FileExistsError: The file exists.
        OSError: It cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self.paths: list[Path] = []
        self._path = path
        self._begin()

    def _begin(self) -> None:
        number = len(self.paths) + 1
        path = self._path if number == 1 else self._path.with_suffix(f".{number:04}{self._path.suffix}")
        self._file: BinaryIO = path.open("xb")
        self.paths.append(path)
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        # Snippets and payloads are mostly compressed already; the chunks of health records are not.
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library="sonarpost")

    def write(self, key: str, encoding: str, payload: bytes, time_ns: int) -> bool:
        """Write a record; return False if its channel would be one more than `MAX_CHANNELS`.

        Args:
            key: Its key.
            encoding: Its Zenoh encoding.
            payload: Its bytes.
            time_ns: Time of reception, ns since 1970-01-01 UTC.

        Raises:
            OSError: The file cannot be written.
        """
        channel = self._channels.get((key, encoding))
        if channel is None:
            if len(self._channels) >= MAX_CHANNELS:
                return False
            record_type = _RECORDS.get(encoding)
            schema = 0
            if record_type is not None:
                name = f"sonarpost.{record_type.TYPE}.v{record_type.VERSION}"
                schema = self._schema(name, record_type.model_json_schema())
            is_msgpack = encoding.startswith("application/msgpack")
            message_encoding = "msgpack" if is_msgpack else "json" if encoding.startswith("application/json") else ""
            channel = self._writer.register_channel(key, message_encoding, schema, {_ENCODING: encoding})
            self._channels[key, encoding] = channel
        self._add(channel, payload, time_ns)
        return True

    def write_json(self, topic: str, schema_name: str, document: Mapping[str, object], time_ns: int) -> None:
        """Write a message of a derived channel.

        Args:
            topic: Its topic, which must begin with `/`.
            schema_name: One of `foxglove.SCHEMAS`.
            document: The message.
            time_ns: Time of reception, ns since 1970-01-01 UTC.

        Raises:
            OSError: The file cannot be written.
        """
        channel = self._channels.get((topic, schema_name))
        if channel is None:
            schema = self._schema(schema_name, SCHEMAS[schema_name])
            channel = self._writer.register_channel(topic, "json", schema, {"derived": "true"})
            self._channels[topic, schema_name] = channel
        self._add(channel, json.dumps(document, allow_nan=False).encode(), time_ns)

    def _schema(self, name: str, schema: Mapping[str, object]) -> int:
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
        return self._schemas[name]

    def _add(self, channel: int, data: bytes, time_ns: int) -> None:
        self._writer.add_message(channel, log_time=time_ns, data=data, publish_time=time_ns)

    def flush(self) -> None:
        """Give complete chunks to the operating system; continue in a new file above `PART_BYTES`.

        Raises:
            OSError: The file cannot be written.
        """
        self._file.flush()
        if self._file.tell() > PART_BYTES:
            self.close()
            self._begin()

    def close(self) -> None:
        """Write the index and close the file.

        Raises:
            OSError: The file cannot be written; it is readable without its end.
        """
        with self._file:
            self._writer.finish()


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One record of a file: key, Zenoh encoding, payload, and time of reception in ns since 1970-01-01 UTC."""

    key: str
    encoding: str
    payload: bytes
    time_ns: int


def read_messages(path: Path) -> Iterator[RecordedMessage]:
    """Read the records of an MCAP file in the order of the file, one chunk in memory at a time.

    Channels whose topic is no key of sonarpost are skipped.

    Raises:
        McapFileError: The file is invalid, exceeds a limit, or is cut off. Records before that place were returned.
        OSError: The file cannot be read.
    """
    channels: dict[int, Channel] = {}
    with path.open("rb") as file:
        if file.read(len(_MAGIC)) != _MAGIC:
            raise McapFileError(str(path), "magic", "other bytes", "an MCAP file")
        while True:
            at = file.tell()
            try:
                found = _next_records(file)
            except _DAMAGE as error:
                reason = str(error) or type(error).__name__
                raise McapFileError(str(path), f"byte {at}", reason, "a complete and valid MCAP record") from error
            if found is None:
                return
            for record in found:
                if isinstance(record, Channel):
                    channels[record.id] = record
                    if len(channels) > MAX_CHANNELS:
                        raise McapFileError(str(path), "channels", len(channels), f"at most {MAX_CHANNELS}")
                elif isinstance(record, Message):
                    channel = channels.get(record.channel_id)
                    if channel is None:
                        raise McapFileError(str(path), "channel_id", record.channel_id, "the id of a channel")
                    if _is_key(channel.topic):
                        encoding = channel.metadata.get(_ENCODING, "")
                        yield RecordedMessage(channel.topic, encoding, record.data, record.log_time)


def _is_key(topic: str) -> bool:
    """Return whether a topic is one key of sonarpost, without wildcards."""
    parts = topic.split("/")
    return topic.startswith(f"{keys.ROOT}/") and all(parts) and not set(topic) & set("*$?#") and topic.isprintable()


def _next_records(file: BinaryIO) -> list[McapRecord] | None:
    """Read one record of the file, or the records of one chunk; None at the footer.

    Raises:
        EOFError: The file ends before.
        Another one of `_DAMAGE`: The record is invalid.
    """
    head = file.read(9)
    if len(head) < 9:
        raise EOFError("end of file: the recording was cut off")
    opcode, length = struct.unpack("<BQ", head)
    if length > MAX_RECORD_BYTES:
        raise ValueError(f"a record of {length} bytes, more than {MAX_RECORD_BYTES}")
    body = file.read(length)
    if len(body) < length:
        raise EOFError("end of file: the recording was cut off")
    if opcode in (Opcode.FOOTER, Opcode.DATA_END):
        return None
    if opcode not in (Opcode.CHANNEL, Opcode.MESSAGE, Opcode.CHUNK):
        return []
    record = next(StreamReader(io.BytesIO(head + body), skip_magic=True, emit_chunks=True).records)
    if not isinstance(record, Chunk):
        return [record]
    size = record.uncompressed_size
    if size > MAX_RECORD_BYTES:
        raise ValueError(f"a chunk of {size} bytes, more than {MAX_RECORD_BYTES}")
    record.data = _decompress(record.compression, record.data, size)
    record.compression = ""
    if len(record.data) != size:
        raise ValueError(f"a chunk with other than {size} bytes")
    return breakup_chunk(record, validate_crc=True)


def _decompress(compression: str, data: bytes, size: int) -> bytes:
    """Decompress at most `size` bytes and one more."""
    if compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            decompressed: bytes = reader.read(size + 1)
            return decompressed
    if compression == "lz4":
        found: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        return found
    if compression:
        raise ValueError(f"compression {compression!r}")
    return data
