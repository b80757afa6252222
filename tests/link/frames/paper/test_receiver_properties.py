"""The paper receiver with any frames in any order: correct bytes, each version once, restarts without effect."""

from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass

from builders.link_state import comparable, field_names, group, plain_of
from builders.paper_images import body_of, header_of, received_of
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import FrameError
from sonarpost.link.coding.byte_ranges import Ranges
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.frame import ContactFrame, HalfFrame, parse_frame
from sonarpost.link.frames.paper.receiver import PaperReceiver, PendingImage
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.link.receiver import Event, FrameRejected, ImageUpdate

RATES = [(1, 32), (3, 64), (2, 256), (6, 32)]
CONTACT = ContactSummary(height_px=80, width_px=140, lat_deg=44.7, lon_deg=-63.6, confidence=1.5)
TIMEOUT_S = 60.0
Key = tuple[int, str]


@dataclass(frozen=True)
class Sent:
    """One image of one source, with its frames."""

    source: int
    image_id: str
    header: StreamHeader
    body: bytes
    frames: tuple[bytes, ...]


@dataclass(frozen=True)
class Step:
    """A frame that arrives, or None for a poll."""

    at: float
    source: int
    frame: bytes | None


@st.composite
def sent_images(draw: st.DrawFn) -> list[Sent]:
    images = []
    for source in range(1, draw(st.integers(1, 2)) + 1):
        for number in range(draw(st.integers(1, 3))):
            length = draw(st.integers(0, 3) | st.integers(0, 200))
            body = bytes((source * 83 + number * 31 + i * 7 + 1) % 255 + 1 for i in range(length))  # never zero
            header = draw(
                st.sampled_from([StreamHeader(1, 0, 80, 140), StreamHeader(0x20, number, 80, 140)])
                | st.builds(StreamHeader, st.just(0x10), st.just(number), st.just(80), st.integers(130, 150))
            )
            contact = draw(st.sampled_from([CONTACT, None]))
            rate = draw(st.sampled_from(RATES))
            image_id = f"00{source}{number}"
            plan = plan_packets(image_id, header.pack() + body, contact, *rate)
            images.append(Sent(source, image_id, header, body, tuple(f for packet in plan for f in packet)))
    return images


@st.composite
def deliveries(draw: st.DrawFn) -> tuple[list[Sent], list[Step]]:
    """Draw images and deliveries of their frames: lost, reordered, repeated, padded or cut, at any times."""
    images = draw(sent_images())
    frames = [(image.source, frame) for image in images for frame in image.frames]
    chosen = draw(st.lists(st.sampled_from(frames), max_size=25))
    if draw(st.booleans()):  # mostly in order, as real packets arrive, so that images become complete
        chosen = sorted(chosen, key=frames.index) + draw(st.lists(st.sampled_from(frames), max_size=5))
    steps, now = [], 0.0
    for source, frame in chosen:
        now += draw(st.sampled_from([0.0, 1.0, 6.1, 30.0, 61.0]))
        if draw(st.integers(0, 9)) == 0:
            steps.append(Step(now, source, None))
        steps.append(Step(now, source, draw(as_it_arrives(frame))))
    return images, steps


@st.composite
def as_it_arrives(draw: st.DrawFn, frame: bytes) -> bytes:
    how = draw(st.sampled_from(["complete"] * 6 + ["padded", "cut"]))
    if how == "padded" and reaches_the_end(frame):
        return frame + bytes(draw(st.integers(1, 40)))
    if how == "cut":
        return frame[: draw(st.integers(0, len(frame)))]
    return frame


def reaches_the_end(frame: bytes) -> bool:
    parsed = parse_frame(frame)
    return isinstance(parsed, ContactFrame) or parse_frame(frame + b"\0") == parsed


def take(receiver: PaperReceiver, step: Step) -> list[Event]:
    if step.frame is None:
        return receiver.poll(step.at)
    return receiver.accept(step.source, step.frame, step.at)


def positions(ranges: Ranges) -> set[int]:
    return {i for start, stop in ranges for i in range(start, stop)}


class Ledger:
    """An independent record of the delivered bytes, which uses only the parser of the receiver."""

    def __init__(self, images: list[Sent]) -> None:
        self.images = {(image.source, image.image_id): image for image in images}
        self.bytes_there: dict[Key, set[int]] = defaultdict(set)
        self.contact_there: dict[Key, bool] = defaultdict(bool)
        self.versions: dict[Key, list[ImageUpdate]] = defaultdict(list)

    def deliver(self, step: Step) -> bool:
        """Record the content of a frame; return whether it parses."""
        try:
            parsed = parse_frame(step.frame or b"")
        except Exception:  # noqa: BLE001 - which exceptions there are is another test's matter
            return False
        key = (step.source, parsed.image_id)
        if isinstance(parsed, HalfFrame):
            self.bytes_there[key] |= set(range(parsed.offset, parsed.stop))
        else:
            self.contact_there[key] = True
        return True

    def check(self, event: ImageUpdate) -> None:
        key = (event.source, event.image_id)
        earlier = self.versions[key]
        assert event.version == len(earlier) + 1
        if event.stream:
            image, there = self.images[key], positions(received_of(event))
            assert header_of(event) == image.header
            assert body_of(event) == bytes(b if i in there else 0 for i, b in enumerate(image.body))
            assert there <= self.bytes_there[key]
            assert event.complete == (len(there) == len(image.body))
            assert event.conflicts == 0
            assert event.contact in (None, CONTACT.rounded())
        if earlier:  # a new version holds more than the one before
            assert knowledge(event) > knowledge(earlier[-1])
        earlier.append(event)


def knowledge(event: ImageUpdate) -> tuple[int, ...]:
    if not event.stream:
        return 1, -1
    return int(event.contact is not None) + len(positions(received_of(event))), int(event.contact is not None)


@given(deliveries())
def test_any_frames_in_any_order_give_correct_bytes_and_each_version_once(
    delivery: tuple[list[Sent], list[Step]],
) -> None:
    images, steps = delivery
    receiver, ledger = PaperReceiver(TIMEOUT_S), Ledger(images)
    for step in steps:
        parses = step.frame is None or ledger.deliver(step)
        events = take(receiver, step)
        rejected = [e for e in events if isinstance(e, FrameRejected)]
        assert len(rejected) == (0 if parses else 1)
        for event in events:
            if isinstance(event, ImageUpdate):
                ledger.check(event)
    for event in receiver.poll(1e9):
        assert isinstance(event, ImageUpdate)
        ledger.check(event)
    assert receiver.next_deadline() is None
    # The last version of each image holds everything that arrived.
    for key, there in ledger.bytes_there.items():
        last = ledger.versions[key][-1]
        assert last.stream
        assert positions(received_of(last)) == there
        assert (last.contact is not None) == ledger.contact_there[key]
    assert set(ledger.versions) == set(ledger.bytes_there) | set(ledger.contact_there)


@given(deliveries(), st.integers(1, 4))
def test_a_restart_at_every_point_changes_nothing(delivery: tuple[list[Sent], list[Step]], max_images: int) -> None:
    steps = [*delivery[1], Step(1e9, 0, None)]
    steady = PaperReceiver(TIMEOUT_S, max_images=max_images)
    restarted = PaperReceiver(TIMEOUT_S, max_images=max_images)
    for step in steps:
        parts = restarted.parts()
        restarted = PaperReceiver(TIMEOUT_S, max_images=max_images)
        assert not restarted.restore(parts)
        assert comparable(take(restarted, step)) == comparable(take(steady, step))
        assert restarted.next_deadline() == steady.next_deadline()
        assert restarted.counts == steady.counts
        assert restarted.parts() == steady.parts()


@st.composite
def hostile_frames(draw: st.DrawFn) -> bytes:
    header = StreamHeader(draw(st.sampled_from([0, 0x10, 0x20])), 0, 80, draw(st.integers(16, 18)))
    body_length = draw(st.integers(0, 12)).to_bytes(2, "big")
    letter = draw(st.sampled_from([b"T", b"B"]))
    image_id = draw(st.sampled_from([b"0000", b"0001", b"0002", b"000x"]))
    offset = draw(st.integers(0, 12)).to_bytes(2, "big")
    half_frame = letter + image_id + offset + body_length + header.pack() + draw(st.binary(max_size=10))
    contact = ContactFrame("0001", ContactSummary(confidence=draw(st.sampled_from([0.0, 1.0, None])))).pack()
    return draw(st.sampled_from([half_frame, half_frame, contact, draw(st.binary(max_size=40))]))


@given(st.lists(st.tuples(st.integers(-1, 2), hostile_frames(), st.floats(-100, 1e6)), max_size=40))
def test_hostile_frames_and_times_never_raise_and_memory_is_bounded(arrivals: list[tuple[int, bytes, float]]) -> None:
    receiver = PaperReceiver(TIMEOUT_S, max_images=3)
    versions: dict[Key, int] = {}
    announced: dict[Key, set[tuple[StreamHeader, int]]] = defaultdict(set)
    for source, frame, now in arrivals:
        with suppress(FrameError):
            if isinstance(parsed := parse_frame(frame), HalfFrame):
                announced[source, parsed.image_id].add((parsed.header, parsed.body_length))
        for event in receiver.accept(source, frame, now):
            if not isinstance(event, ImageUpdate):
                assert isinstance(event, FrameRejected)
                continue
            key = (event.source, event.image_id)
            # Deleted images start again at 1; otherwise versions count up one by one.
            assert event.version in (1, versions.get(key, 0) + 1)
            versions[key] = event.version
            if event.stream:
                there = positions(received_of(event))
                assert (header_of(event), len(body_of(event))) in announced[key]
                assert all(byte == 0 for i, byte in enumerate(body_of(event)) if i not in there)
        parts = receiver.parts()
        stored = group(parts, "image")
        assert len(stored) <= 3
        at = field_names(PendingImage).index("candidates")
        assert all(len(plain_of(parts, name)[at]) <= 3 for name in stored)
    assert receiver.counts.frames == len(arrivals)
