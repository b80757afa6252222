"""`sonarpost record` and `sonarpost replay`: the records of a router into an MCAP file, and back."""

import argparse
import hashlib
import sys
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

import zenoh

from sonarpost import keys, wire
from sonarpost.archive.image_parts import whole_part
from sonarpost.bus.session import open_with_retry
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import add_router_options, add_site_option, flag, in_new_folder, option, router_of
from sonarpost.delivery.client import deliver
from sonarpost.delivery.protocol import attachment, watcher_origin
from sonarpost.delivery.records import OutboxItem
from sonarpost.errors import BadInputError, ConfigError, PayloadError
from sonarpost.export.live import LiveContacts
from sonarpost.extensions.mcap.foxglove import (
    COMPRESSED_IMAGE,
    GEOJSON,
    LOCATION_FIX,
    compressed_image,
    contact_map,
    location_fix,
)
from sonarpost.messages import CodedImage, Decision, ImagePart, ReconstructedImage, Relayed
from sonarpost.stop_signals import stop_on_signals

if TYPE_CHECKING:
    # Imported when a command runs: they need the extra `mcap`.
    from sonarpost.extensions.mcap.mcap_file import McapRecording, RecordedMessage

MAX_QUEUED_BYTES: Final = 256 << 20
"""Received records that wait to be written; further ones are dropped, and counted."""
MAP_CONTACTS: Final = 500
MAP_INTERVAL_NS: Final = 10_000_000_000
POLL_S: Final = 0.2
EXIT_INCOMPLETE: Final = 1


def add_record(parser: CommandParser) -> None:
    """Add the command `record`."""
    parser.description = (
        "Record the publications of a router into an MCAP file, with image, position and map of the "
        "contacts for Foxglove. Ctrl-C ends it. Exit status 1: records were dropped."
    )
    option(parser, "out OUT.mcap", "file to write; it must not exist", Path)
    add_router_options(parser)
    option(
        parser,
        "--key EXPR",
        f"key expression to record; can be repeated (default: {keys.everything()})",
        action="append",
    )
    option(parser, "--duration S", "end after this time", float)
    parser.set_defaults(run=run_record)


def add_replay(parser: CommandParser) -> None:
    """Add the command `replay`."""
    parser.description = (
        "Publish the records of an MCAP file for watchers, or send images, coded images and "
        "decisions to a running c2. "
        "Exit status 1: c2 has refused records."
    )
    option(parser, "file FILE.mcap", "file to read", Path)
    add_router_options(parser)
    option(parser, "--speed X", "factor of the original speed; 0: no pauses", float, 1.0)
    option(parser, "--key EXPR", "only keys that this key expression includes")
    flag(parser, "--to-c2", "deliver images and decisions durably to the c2 of --site; publish nothing")
    add_site_option(parser)
    option(parser, "--timeout S", "time limit of each delivery", float, 30.0)
    parser.set_defaults(run=run_replay)


# record


class RecordQueue:
    """Received samples that wait to be written, bounded in bytes. Zenoh's threads add, the main thread takes."""

    def __init__(self) -> None:
        self.dropped = 0
        self._bytes = 0
        self._samples: deque[RecordedMessage] = deque()
        self._changed = threading.Condition()

    def add(self, message: "RecordedMessage") -> None:
        """Add a message, or drop and count it above the limit."""
        with self._changed:
            if self._bytes + len(message.payload) > MAX_QUEUED_BYTES:
                self.dropped += 1
                return
            self._bytes += len(message.payload)
            self._samples.append(message)
            self._changed.notify()

    def take(self, timeout_s: float) -> "list[RecordedMessage]":
        """Return all waiting messages, after at most `timeout_s` if there is none."""
        with self._changed:
            if not self._samples:
                self._changed.wait(timeout_s)
            taken = list(self._samples)
            self._samples.clear()
            self._bytes = 0
            return taken


class ContactChannels:
    """Derives the Foxglove channels of contacts from images and decisions.

    Args:
        recording: The file.
    """

    def __init__(self, recording: "McapRecording") -> None:
        self._recording = recording
        self._contacts = LiveContacts()
        self._map_due_ns: int | None = None
        self._is_changed = False

    def add(self, message: "RecordedMessage") -> None:
        """Write what is derived from one record; a coded image and an undecodable record have none."""
        record = _record_for_c2(message.key, message.payload)
        if record is None or isinstance(record, CodedImage):
            return
        time_ns = message.time_ns
        if isinstance(record, ReconstructedImage):
            # The key is part of the topic: a router can carry one image under the keys of a vessel and of a site.
            prefix = "/" + message.key.removeprefix(f"{keys.ROOT}/")
            self._recording.write_json(prefix, COMPRESSED_IMAGE, compressed_image(record, time_ns), time_ns)
            fix = location_fix(record, time_ns)
            if fix is not None:
                self._recording.write_json(f"{prefix}/position", LOCATION_FIX, fix, time_ns)
        self._is_changed |= self._contacts.add(record) is not None
        self.write_map(time_ns)

    def write_map(self, time_ns: int, *, now: bool = False) -> None:
        """Write the map of the latest contacts if it has changed, at most every 10 s unless `now`."""
        if not self._is_changed or not (now or self._map_due_ns is None or time_ns >= self._map_due_ns):
            return
        self._recording.write_json("/contacts", GEOJSON, contact_map(self._contacts.located(MAP_CONTACTS)), time_ns)
        self._is_changed = False
        self._map_due_ns = time_ns + MAP_INTERVAL_NS


def run_record(parsed: argparse.Namespace) -> int:
    """Record until interrupted or until the duration has passed; return 0, or 1 if records were dropped."""
    # Imported lazily: they need the extra `mcap`.
    from sonarpost.extensions.mcap.mcap_file import McapRecording, RecordedMessage  # noqa: PLC0415

    endpoints, tls = router_of(parsed)
    expressions = [_key_expression(text) for text in parsed.key or [keys.everything()]]
    waiting = RecordQueue()

    def receive(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            payload, encoding = sample.payload.to_bytes(), str(sample.encoding)
            waiting.add(RecordedMessage(str(sample.key_expr), encoding, payload, time.time_ns()))

    with stop_on_signals() as stop:
        session = open_with_retry(endpoints, stop, tls)
        if session is None:
            return 0
        recording = McapRecording(in_new_folder(parsed.out))
        written = skipped = 0
        try:
            for expression in expressions:
                session.declare_subscriber(expression, receive)
            print(f"sonarpost record: recording {', '.join(expressions)} at {', '.join(endpoints)}", file=sys.stderr)
            channels = ContactChannels(recording)
            ends_s = None if parsed.duration is None else time.monotonic() + parsed.duration
            while not stop.is_set() and (ends_s is None or time.monotonic() < ends_s):
                for message in waiting.take(POLL_S):
                    is_written = recording.write(message.key, message.encoding, message.payload, message.time_ns)
                    written, skipped = written + is_written, skipped + (not is_written)
                    if is_written:
                        channels.add(message)
                channels.write_map(time.time_ns())
                recording.flush()
            channels.write_map(time.time_ns(), now=True)
        finally:
            session.close()
            recording.close()
    dropped = waiting.dropped + skipped
    print(f"{', '.join(map(str, recording.paths))}: {written} records, {dropped} dropped")
    return EXIT_INCOMPLETE if dropped else 0


def _key_expression(text: str) -> str:
    try:
        return str(zenoh.KeyExpr.autocanonize(text))
    except zenoh.ZError as error:
        raise ConfigError("command line", "--key", text, "a Zenoh key expression") from error


# replay


def run_replay(parsed: argparse.Namespace) -> int:
    """Replay a file; return 0, or 1 if c2 has refused records."""
    from sonarpost.extensions.mcap.mcap_file import read_messages  # noqa: PLC0415  as in `run_record`

    if not parsed.speed >= 0:
        raise ConfigError("command line", "--speed", parsed.speed, "0 or more")
    chosen = _key_expression(parsed.key or keys.everything())
    endpoints, tls = router_of(parsed)
    with stop_on_signals() as stop:
        session = open_with_retry(endpoints, stop, tls)
        if session is None:
            return 0
        send: Publisher | C2Sender = (
            C2Sender(session, parsed.site, parsed.timeout) if parsed.to_c2 else Publisher(session)
        )
        expression = zenoh.KeyExpr(chosen)
        messages = (m for m in read_messages(parsed.file) if expression.includes(zenoh.KeyExpr(m.key)))
        try:
            for message in paced(messages, parsed.speed, stop.wait):
                send(message)
        finally:
            session.close()
            print(f"{parsed.file}: {send.sent} records sent, {send.refused} refused, {send.skipped} of other keys")
    return EXIT_INCOMPLETE if send.refused else 0


def paced(
    messages: "Iterable[RecordedMessage]",
    speed: float,
    wait: Callable[[float], bool],
    clock: Callable[[], float] = time.monotonic,
) -> "Iterator[RecordedMessage]":
    """Yield messages at `speed` times their original speed, 0 without pauses; end when `wait` returns True.

    Args:
        messages: In the order of the file. A message that is earlier than those before it is not delayed.
        speed: Factor, 0 or more.
        wait: Waits, argument in seconds; `threading.Event.wait` fits.
        clock: Monotonic clock in seconds.
    """
    started_s = clock()
    first_ns: int | None = None
    for message in messages:
        first_ns = message.time_ns if first_ns is None else first_ns
        due_s = started_s + (message.time_ns - first_ns) / 1e9 / speed if speed else 0.0
        while (left_s := due_s - clock()) > 0:
            if wait(min(left_s, POLL_S)):
                return
        if wait(0):
            return
        yield message


class Publisher:
    """Publishes records on their keys for watchers.

    Each publication has the attachment of a watcher's copy (docs/specifications/delivery.md): services that consume the
    key do not handle it.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self.sent = self.refused = self.skipped = 0
        self._session = session
        self._origin = watcher_origin(uuid.uuid4().bytes)

    def __call__(self, message: "RecordedMessage") -> None:
        """Publish one record."""
        self.sent += 1
        digest = hashlib.sha256(message.payload).digest()
        item = OutboxItem("replay", self.sent, message.key, "", 5, message.payload, digest)
        self._session.put(
            message.key,
            message.payload,
            encoding=message.encoding,
            congestion_control=zenoh.CongestionControl.BLOCK,
            attachment=attachment(self._origin, item),
        )


class C2Sender:
    """Delivers images, coded images and decisions durably to a c2, as a relay does. c2 stores a repeated record once.

    Args:
        session: Session at the router of the site.
        site: Name of the site.
        timeout_s: Time limit of each delivery.
    """

    def __init__(self, session: zenoh.Session, site: str, timeout_s: float) -> None:
        self.sent = self.refused = self.skipped = 0
        self._session = session
        self._site = site
        self._timeout_s = timeout_s
        self._origin = uuid.uuid4().bytes
        # Deliveries are numbered for each key: that of a refused record is used too.
        self._last: dict[str, int] = {}

    def __call__(self, message: "RecordedMessage") -> None:
        """Deliver one record.

        Raises:
            NotDeliveredError: c2 did not accept it in time.
        """
        record = _record_for_c2(message.key, message.payload)
        if record is None:
            self.skipped += 1
            return
        vessel = record.vessel_id
        sent: ImagePart | Relayed
        if isinstance(record, CodedImage):
            key, sent = keys.shore_part(vessel, self._site), whole_part(record)
        else:
            is_image = isinstance(record, ReconstructedImage)
            inner = keys.image_reconstructed(vessel) if is_image else keys.contact_decision(vessel)
            sent = Relayed(vessel_id=vessel, key=inner, payload=message.payload, relayed_utc_s=time.time())
            key = keys.shore_inbox(vessel, self._site)
        self._last[key] = seq = self._last.get(key, 0) + 1
        try:
            deliver(self._session, key, "c2", sent, self._timeout_s, origin=self._origin, seq=seq)
        except PayloadError as error:
            self.refused += 1
            print(f"refused: {error}", file=sys.stderr)
        else:
            self.sent += 1


StoredRecord = CodedImage | Decision | ReconstructedImage
_OF_VESSEL: Final[dict[str, type[StoredRecord]]] = {
    "image/coded": CodedImage,
    "image/reconstructed": ReconstructedImage,
    "contact/decision": Decision,
}
_AT_SHORE: Final[dict[str, type[StoredRecord]]] = {
    "coded": CodedImage,
    "decision": Decision,
    "image": ReconstructedImage,
}


def _record_for_c2(key: str, payload: bytes) -> StoredRecord | None:
    """Decode an image or decision of a vessel, or of a shore site; None for other keys and undecodable records."""
    parts = key.removeprefix(f"{keys.ROOT}/").split("/")[1:]
    record_type = _OF_VESSEL.get("/".join(parts))
    if record_type is None and len(parts) == 3 and parts[0] == "contact":
        record_type = _AT_SHORE.get(parts[2])
    if record_type is None:
        return None
    try:
        return wire.decode(record_type, payload, key)
    except BadInputError:
        # The recording holds the payload as it is; a replay counts it as one of another key.
        return None
