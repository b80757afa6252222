"""Authentication of frames: accepted and rejected frames, restarts, the lifetime of a key, the complete link."""

import itertools
import random
import re

import pytest
from builders.authentication_world import VEHICLE, VESSEL, key, vehicle_authenticator, vessel_authenticator
from builders.link_state import group, with_fields
from builders.v1_world import add_message, contact, feedback_frame, stream

from sonarpost.errors import ConfigError, FrameError
from sonarpost.link.auth.authentication import (
    RESERVED,
    WINDOW,
    AuthenticationCounts,
    AuthenticationState,
    FrameAuthenticator,
    SavedWindow,
)
from sonarpost.link.auth.key import AuthenticationSettings, Direction
from sonarpost.link.coding.channel_capacity import LossChannel
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import number_of_image
from sonarpost.link.frames.v1.frame import Symbol, SymbolKind, checksum, pack_symbol, parse_frame
from sonarpost.link.frames.v1.receiver import V1Receiver
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.link.receiver import FeedbackReceived, FrameRejected, ImageUpdate

ALL_SETTINGS = [
    AuthenticationSettings(counter, tag, encrypt)
    for counter, tag, encrypt in itertools.product((1, 2), (4, 6, 8), (False, True))
]
COVERED = b"\x80 a frame after its checksum"


def rejected_field(authenticator: FrameAuthenticator, protected: bytes, source: int = VEHICLE) -> str:
    """Return the field of the error of a rejected frame."""
    with pytest.raises(FrameError) as caught:
        authenticator.verify(source, protected)
    return caught.value.field


@pytest.mark.parametrize("settings", ALL_SETTINGS, ids=str)
def test_protected_frame_round_trip_and_overhead(settings: AuthenticationSettings) -> None:
    vehicle, vessel = vehicle_authenticator(settings), vessel_authenticator(settings)
    for covered in (COVERED, b"\x80", b"\x80" + bytes(300)):
        protected = vehicle.protect(covered)
        assert (
            len(protected)
            == len(covered) + settings.counter_bytes + settings.tag_bytes
            == len(covered) + vehicle.overhead_bytes
        )
        assert protected[0] == 0x80
        assert (covered[1:] in protected) == (not settings.encrypt or len(covered) == 1)
        assert vessel.verify(VEHICLE, protected) == covered
    assert (vehicle.counts, vessel.counts) == (AuthenticationCounts(protected=3), AuthenticationCounts(genuine=3))


@pytest.mark.parametrize("settings", [AuthenticationSettings(), AuthenticationSettings(encrypt=True)], ids=str)
def test_all_bits_are_authenticated(settings: AuthenticationSettings) -> None:
    # At the end of the key's lifetime the vessel has few counters to try.
    vehicle, vessel = vehicle_authenticator(settings, first_counter=2**20 - 3), vessel_authenticator(settings)
    assert rejected_field(vessel, vehicle.protect(COVERED)) == "counter"
    vessel.verify(VEHICLE, vehicle.protect(COVERED))
    protected = vehicle.protect(COVERED)
    for bit in range(8 * len(protected)):
        damaged = bytearray(protected)
        damaged[bit // 8] ^= 1 << bit % 8
        assert rejected_field(vessel, bytes(damaged)) == "tag"
    assert vessel.counts.forged == 8 * len(protected)
    assert vessel.verify(VEHICLE, protected) == COVERED


def test_frame_of_another_sender_key_or_setting_is_forged() -> None:
    protected = vehicle_authenticator().protect(COVERED)
    vessel = vessel_authenticator()
    assert rejected_field(vessel, protected, VEHICLE + 1) == "tag"  # another vehicle's
    assert rejected_field(vessel_authenticator(name="another key"), protected) == "tag"
    assert rejected_field(vessel_authenticator(AuthenticationSettings(encrypt=True)), protected) == "tag"
    assert rejected_field(vessel_authenticator(AuthenticationSettings(tag_bytes=6)), protected) == "tag"
    own = FrameAuthenticator(key("fleet"), VEHICLE, Direction.TO_VEHICLE)
    own.grant(10)
    assert rejected_field(own, own.protect(COVERED)) == "tag"  # its own frame, returned
    for source in (-1, 256, 2**40):
        assert rejected_field(vessel, protected, source) == "tag"
    for short in (b"", b"\x80", protected[: vessel.overhead_bytes]):
        assert rejected_field(vessel, short) == "tag"
    assert vessel.verify(VEHICLE, protected) == COVERED


def test_replay_is_distinguished_from_forgery_at_any_age() -> None:
    vehicle, vessel = vehicle_authenticator(), vessel_authenticator()
    recorded = [vehicle.protect(COVERED) for _ in range(3000)]
    for protected in recorded:
        vessel.verify(VEHICLE, protected)
    for protected in recorded[::100] + recorded[-70:]:
        assert rejected_field(vessel, protected) == "counter"
    assert rejected_field(vessel, COVERED + b"\x07guess") == "tag"
    assert vessel.counts == AuthenticationCounts(genuine=3000, replayed=100, forged=1)


@pytest.mark.parametrize(
    ("settings", "bridged"), [(AuthenticationSettings(), 191), (AuthenticationSettings(2), 65471)], ids=str
)
def test_long_losses_cost_one_frame_at_most(settings: AuthenticationSettings, bridged: int) -> None:
    assert bridged + 1 == settings.counter_step - WINDOW
    vessel = vessel_authenticator(settings)

    def frame(counter: int) -> bytes:
        return vehicle_authenticator(settings, first_counter=counter).protect(COVERED)

    vessel.verify(VEHICLE, frame(0))
    last = bridged + 1
    assert vessel.verify(VEHICLE, frame(last)) == COVERED
    first = last + bridged + 2
    for _ in range(2):  # a repetition confirms nothing
        assert rejected_field(vessel, frame(first)) == "counter"
    for counter in (first + bridged + 1, first + bridged + 2):  # the second need not follow directly
        assert vessel.verify(VEHICLE, frame(counter)) == COVERED
    assert vessel.counts == AuthenticationCounts(genuine=4, unconfirmed=2)


def test_receiver_without_state_finds_any_counter() -> None:
    last = AuthenticationSettings().lifetime_frames - 2
    vehicle, vessel = vehicle_authenticator(first_counter=last), vessel_authenticator()
    assert rejected_field(vessel, vehicle.protect(COVERED)) == "counter"
    assert vessel.verify(VEHICLE, vehicle.protect(COVERED)) == COVERED
    with pytest.raises(FrameError, match="a new key after 1048576 frames"):
        vehicle.protect(COVERED)
    assert (vehicle.frames_left, vehicle.requested_limit) == (0, None)


def test_protection_requires_a_reservation() -> None:
    authenticator = FrameAuthenticator(key("fleet"), VEHICLE, Direction.FROM_VEHICLE)
    with pytest.raises(FrameError, match="a granted limit above it"):
        authenticator.protect(COVERED)
    authenticator.grant(1)
    authenticator.protect(COVERED)
    with pytest.raises(FrameError):
        authenticator.protect(COVERED)
    for wrong in (0, AuthenticationSettings().lifetime_frames + 1):
        with pytest.raises(ConfigError, match="limit"):
            authenticator.grant(wrong)


def test_restored_sender_continues_after_its_reservation() -> None:
    vehicle = FrameAuthenticator(key("fleet"), VEHICLE, Direction.FROM_VEHICLE)
    vehicle.grant(64)
    vessel = vessel_authenticator()
    vessel.verify(VEHICLE, vehicle.protect(COVERED))
    older = vehicle.parts()
    again = FrameAuthenticator(key("fleet"), VEHICLE, Direction.FROM_VEHICLE, first_counter=128)
    assert not again.restore(older)
    assert again.requested_limit == 128 + RESERVED
    again.grant(128 + RESERVED)
    vessel.verify(VEHICLE, again.protect(COVERED))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("authentication", {"format version": 1}),
        ("authentication", {"key": 7}),
        ("authentication", {"limit": -1}),
        ("authentication", {"limit": True}),
        ("authentication", {"counts": None}),
        ("authentication", {"counts": {"protected": -1}}),
        ("window/3", {"format version": None}),
        ("window/3", {"window": None}),
        ("window/3", {"source": 256}),
        ("window/3", {"window": {"newest": -1, "seen": 0}}),
        ("window/3", {"window": {"newest": 2**20, "seen": 0}}),
        ("window/3", {"window": {"newest": 5, "seen": bytes(8)}}),
    ],
)
def test_a_malformed_part_is_reported_and_skipped(name: str, change: dict[str, object]) -> None:
    vehicle, vessel = vehicle_authenticator(), vessel_authenticator()
    vessel.verify(VEHICLE, vehicle.protect(COVERED))
    restored = vessel_authenticator()
    errors = restored.restore(
        with_fields(vessel.parts(), name, SavedWindow if "window" in name else AuthenticationState, change)
    )
    assert set(errors) == {name}
    assert f"authentication state: {name}: " in str(errors[name])
    assert "window/3" not in restored.parts()
    assert restored.counts == (vessel.counts if name == "window/3" else AuthenticationCounts())


def test_a_state_of_another_key_has_no_effect() -> None:
    vehicle, vessel = vehicle_authenticator(name="another key"), vessel_authenticator(name="another key")
    vessel.verify(VEHICLE, vehicle.protect(COVERED))
    restored = vessel_authenticator()
    assert restored.restore(vessel.parts()) == {}
    assert restored.parts() == vessel_authenticator().parts()


def test_a_limit_beyond_the_lifetime_leaves_no_counter() -> None:
    vehicle = vehicle_authenticator()
    parts = with_fields(vehicle.parts(), "authentication", AuthenticationState, {"limit": 2**20 + 1})
    restored = FrameAuthenticator(key("fleet"), VEHICLE, Direction.FROM_VEHICLE)
    assert restored.restore(parts) == {}
    assert restored.frames_left == 0


def test_forged_frames_use_no_memory() -> None:
    vessel = vessel_authenticator(AuthenticationSettings(2))
    for source in (0, VEHICLE, 255):
        assert rejected_field(vessel, COVERED + b"\0\0fake", source) == "tag"
    assert group(vessel.parts(), "window") == {}


@pytest.mark.parametrize("wrong", [{"counter_bytes": 3}, {"counter_bytes": 0}, {"tag_bytes": 5}, {"tag_bytes": 16}])
def test_settings_out_of_range_are_rejected(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        AuthenticationSettings(**wrong)  # type: ignore[arg-type]
    for address, first in ((-1, 0), (256, 0), (1, -1), (1, 2**20 + 1)):
        with pytest.raises(ConfigError, match="acoustic authentication"):
            FrameAuthenticator(key("fleet"), address, Direction.FROM_VEHICLE, first_counter=first)


def test_damage_is_distinguished_from_forgery() -> None:
    vehicle, vessel = vehicle_authenticator(), vessel_authenticator()
    frame = pack_symbol(Symbol(SymbolKind.OBJECT, 1, 2, 3, bytes(54)), vehicle)
    assert len(frame) == 64
    damaged = bytes([*frame[:20], frame[20] ^ 1, *frame[21:]])
    rewritten = checksum(damaged[2:]).to_bytes(2, "big") + damaged[2:]
    bare = pack_symbol(Symbol(SymbolKind.OBJECT, 1, 2, 3, bytes(54)))
    for sent, used, field in (
        (damaged, vessel, "checksum"),
        (rewritten, vessel, "tag"),
        (bare, vessel, "tag"),
        (frame, None, "tag"),
    ):
        with pytest.raises(FrameError) as caught:
            parse_frame(sent, VEHICLE, used)
        assert caught.value.field == field
    assert vessel.counts == AuthenticationCounts(forged=1)
    padded = frame + bytes(192)
    assert parse_frame(padded, VEHICLE, vessel) == Symbol(SymbolKind.OBJECT, 1, 2, 3, bytes(54))
    with pytest.raises(FrameError, match=re.escape("one not accepted before")):
        parse_frame(frame, VEHICLE, vessel)


@pytest.mark.parametrize(
    ("frame_bytes", "settings"),
    [(32, AuthenticationSettings()), (64, AuthenticationSettings(encrypt=True)), (256, AuthenticationSettings())],
)
def test_images_and_feedback_with_authentication(frame_bytes: int, settings: AuthenticationSettings) -> None:
    up, down = vehicle_authenticator(settings), vessel_authenticator(settings)
    down.grant(1000)
    config = SenderConfig(frame_bytes=frame_bytes, channels=(LossChannel(0.2),), feedback=True, stream_bytes=200)
    vehicle, feedback_receiver = V1Sender(config, protection=up), V1Receiver(protection=up)
    vessel = V1Receiver(protection=down)
    images = {number: stream(number, 200) for number in range(1, 5)}
    for number, data in images.items():
        vehicle.add_image(number, contact(number), data, 0.0)
    add_message(vehicle, b"status", 0.0)
    received: dict[int, bytes] = {}
    now, channel = 0.0, random.Random(1)
    while not vehicle.is_idle and now < 20_000:
        now += 1
        frame = vehicle.next_frame(now)
        if frame is not None:
            assert len(frame) == frame_bytes
            if channel.random() < 0.8:
                events = vessel.accept(VEHICLE, frame, now)
                assert not [e for e in events if isinstance(e, FrameRejected)]
                received |= {number_of_image(e.image_id): e.stream for e in events if isinstance(e, ImageUpdate)}
                (again,) = vessel.accept(VEHICLE, frame, now)
                assert isinstance(again, FrameRejected)
                assert again.reason.field == "counter"
        if vessel.feedback_is_due(VEHICLE, now):
            feedback = vessel.feedback(VEHICLE, now)
            assert feedback is not None
            (event,) = feedback_receiver.accept(VESSEL, feedback_frame(feedback, down), now)
            assert isinstance(event, FeedbackReceived)
            vehicle.on_feedback(event.feedback, now)
    assert vehicle.is_idle
    assert received == images
    assert up.counts.protected > down.counts.genuine == down.counts.replayed > 0
