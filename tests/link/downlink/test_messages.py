"""Bytes inside messages: golden vectors, round trips, hostile bytes."""

import json
from dataclasses import asdict

import pytest
from builders.common import GOLDEN_FOLDER
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.codec.region import RegionBox
from sonarpost.errors import FrameError
from sonarpost.link.downlink import messages as dl
from sonarpost.link.downlink.status_message import StatusMessage
from sonarpost.link.frames.v1.frame import Segment, SegmentKind, pack_segments, parse_frame

GOLDEN = GOLDEN_FOLDER / "acoustic-v1" / "messages.json"
SAMPLES: dict[str, dl.DownlinkContent] = {
    "refine-192": dl.RefineMessage(0x01020304, 1_790_000_000, 7, 192),
    "refine-all": dl.RefineMessage(0xFFFFFFFF, 1_790_000_001, 65535),
    "resend": dl.ResendMessage(0, 0, 1),
    "revisit": dl.RevisitMessage(5, 1_790_000_002, -41.5251234, 170.6712345),
    "decision": dl.DecisionMessage(6, 1_790_000_003, 300, 4, "not_mine_like", 0.5, "Manta"),
    "decision-bare": dl.DecisionMessage(7, 4_294_967_295, 300, 300, "unsure"),
    "confirmation": dl.ConfirmationMessage(
        ((1, dl.CommandOutcome.ACCEPTED), (2**32 - 1, dl.CommandOutcome.UNKNOWN_IMAGE))
    ),
    "expand": dl.ExpandMessage(0x0A0B0C0D, 1_790_000_004, 7),
    "original": dl.OriginalMessage(0x0A0B0C0E, 1_790_000_005, 7),
    "region": dl.RegionMessage(0x0A0B0C0F, 1_790_000_006, 7, RegionBox(4, 8, 20, 32), 192),
    "region-corner": dl.RegionMessage(1, 0, 65535, RegionBox(31, 31, 32, 32), 65535),
    "prioritise-first": dl.PrioritiseMessage(0x0A0B0C10, 1_790_000_007, 7, "first"),
    "prioritise-last": dl.PrioritiseMessage(0x0A0B0C11, 1_790_000_008, 8, "last"),
    "status": StatusMessage(
        time_utc_s=1_790_000_009,
        lat_deg=41.5251234,
        lon_deg=-70.6712345,
        heading_deg=271.5,
        speed_mps=-1.5,
        depth_m=12.4,
        altitude_m=3.5,
        swath_m=76.0,
        battery=0.63,
        images_waiting=4,
        disk_free_bytes=11_585_237_503,
    ),
    "status-unknown": StatusMessage(time_utc_s=0),
    "status-limits": StatusMessage(
        time_utc_s=2**32 - 1,
        lat_deg=-90.0,
        lon_deg=180.0,
        heading_deg=358.5,
        speed_mps=12.7,
        depth_m=13106.8,
        altitude_m=127.0,
        swath_m=508.0,
        battery=1.0,
        images_waiting=254,
        disk_free_bytes=0,
    ),
    "data": dl.DataMessage(b"\x00status"),
}


@pytest.mark.parametrize("name", SAMPLES)
def test_golden_bytes(name: str) -> None:
    vectors = json.loads(GOLDEN.read_text())
    packed = bytes.fromhex(vectors[name]["hex"])
    assert dl.pack(SAMPLES[name]) == packed
    assert dl.pack(dl.unpack(packed)) == packed
    assert json.loads(json.dumps(asdict(dl.unpack(packed)), default=bytes.hex)) == vectors[name]["fields"]


numbers = st.integers(1, 65535)
heads = {"token": st.integers(0, 2**32 - 1), "issued_utc_s": st.integers(0, 2**32 - 1)}
starts, lengths = st.integers(0, 31), st.integers(1, 32)
boxes = st.builds(
    lambda top, left, height, width: RegionBox(top, left, min(32, top + height), min(32, left + width)),
    starts,
    starts,
    lengths,
    lengths,
)
commands = st.one_of(
    st.builds(dl.RefineMessage, **heads, number=numbers, stream_bytes=st.integers(0, 65535)),
    st.builds(dl.ResendMessage, **heads, number=numbers),
    st.builds(dl.ExpandMessage, **heads, number=numbers),
    st.builds(dl.OriginalMessage, **heads, number=numbers),
    st.builds(dl.RegionMessage, **heads, number=numbers, box=boxes, stream_bytes=st.integers(24, 65535)),
    st.builds(dl.PrioritiseMessage, **heads, number=numbers, place=st.sampled_from(["first", "last"])),
    st.builds(
        dl.RevisitMessage,
        **heads,
        lat_deg=st.integers(-900_000_000, 900_000_000).map(lambda n: n / 1e7),
        lon_deg=st.integers(-1_800_000_000, 1_800_000_000).map(lambda n: n / 1e7),
    ),
    st.builds(
        dl.DecisionMessage,
        **heads,
        number=numbers,
        version=st.integers(1, 255),
        verdict=st.sampled_from(["mine_like", "not_mine_like", "unsure"]),
        confidence=st.none() | st.integers(0, 254).map(lambda n: n / 254),
        mlo_class=st.text(st.characters(codec="ascii"), max_size=13),
    ),
)


@given(commands)
def test_command_round_trip_in_32_bytes(command: dl.DownlinkCommand) -> None:
    message = Segment(SegmentKind.MESSAGE, b"\x05" + dl.pack(command))
    (segment,) = parse_frame(pack_segments([message], 32))
    assert isinstance(segment, Segment)
    assert dl.unpack(segment.data[1:]) == command


@given(st.text("aZ0 \0é\u0663€\U0001f600", max_size=60), st.integers(14, 60))
def test_class_is_cut_between_characters(text: str, room_bytes: int) -> None:
    packed = dl.pack(dl.DecisionMessage(1, 2, 3, 1, "unsure", None, text), room_bytes)
    found = dl.unpack(packed)
    assert isinstance(found, dl.DecisionMessage)
    assert len(packed) <= room_bytes
    assert text.startswith(found.mlo_class)
    lost = text[len(found.mlo_class) :]
    assert not lost or len(packed) + len(lost[0].encode()) > room_bytes


@given(st.binary(max_size=40))
def test_hostile_bytes_parse_or_raise_frame_error(data: bytes) -> None:
    try:
        content = dl.unpack(data, "modem 3")
    except FrameError as error:
        where = error.where
    else:
        where = "modem 3"
        assert dl.unpack(dl.pack(content, 60)) == content
    assert where == "modem 3"


@pytest.mark.parametrize(
    ("packed", "field"),
    [
        (b"", "kind"),
        (b"\x07", "length"),
        (b"\x07" + bytes(8) + b"\0\1" + b"\x22\x27\xf1" + b"\0\xc0", "box"),
        (b"\x07" + bytes(8) + b"\0\1" + b"\x22\x00\x00" + b"\0\xc0", "box"),
        (b"\x07" + bytes(8) + b"\0\1" + b"\x22\x27\xf0" + b"\0\x17", "stream_bytes"),
        (b"\x07" + bytes(8) + b"\0\0" + b"\x22\x27\xf0" + b"\0\xc0", "number"),
        (b"\x09" + bytes(8) + b"\0\1\2", "place"),
        (b"\x09" + bytes(8) + b"\0\0\1", "number"),
        (b"\x0a", "kind"),
        (b"\x01\0\0", "length"),
        (bytes(9), "kind"),
        (b"\x01" + bytes(8) + b"\0\1\0", "length"),
        (b"\x01" + bytes(12), "number"),
        (b"\x03" + bytes(8) + b"\x7f" * 8, "lat_deg"),
        (b"\x04" + bytes(8) + b"\0\1\1\3\xff", "verdict"),
        (b"\x04" + bytes(8) + b"\0\1\0\0\xff", "version"),
        (b"\x04" + bytes(8) + b"\0\1\1\0\xff\xc3", "mlo_class"),
        (b"\x05" + bytes(8) + b"\0\1\0", "length"),
        (b"\x05" + bytes(10), "number"),
        (b"\x06" + bytes(8) + b"\0\1\0", "length"),
        (b"\x06" + bytes(10), "number"),
        (b"\x08" + bytes(4), "length"),
        (b"\x08" + bytes(4) + b"\x09", "outcome"),
        (b"\x10", "data"),
    ],
)
def test_error_names_the_invalid_field(packed: bytes, field: str) -> None:
    with pytest.raises(FrameError) as caught:
        dl.unpack(packed)
    assert caught.value.field == field


def test_confirmations_fill_messages() -> None:
    outcomes = [(token, dl.CommandOutcome.ACCEPTED) for token in range(12)]
    made = dl.confirmations(outcomes)
    assert [len(each.outcomes) for each in made] == [5, 5, 2]
    assert [pair for each in made for pair in each.outcomes] == outcomes
    assert max(len(dl.pack(each)) for each in made) <= dl.SMALLEST_ROOM_BYTES


def test_token_depends_on_record_and_attempt() -> None:
    assert dl.token_of("c-1", "command") == dl.token_of("c-1", "command")
    assert len({dl.token_of("c-1", "command", n) for n in range(9)} | {dl.token_of("c-1", "decision")}) == 10
    assert dl.record_id_of(1, 0xAB) == "a1-000000ab"


def test_image_identifiers_and_contact_numbers() -> None:
    for number in (1, 35, 36, 1000, 65535):
        assert dl.number_of_image(dl.image_of_number(number)) == number
    assert (dl.image_of_number(1), dl.image_of_number(65535)) == ("0001", "1EKF")
    following = [dl.number_of_image(image_id) for image_id in ("1EKE", "1EKF", "1EKG", "1EKH")]
    assert following == [65534, 65535, 1, 2]
    assert 1 <= dl.number_of_image("0000") <= 65535
    for wrong in ("", "000", "00a1", "00001", "-001", "0_01"):
        with pytest.raises(FrameError):
            dl.number_of_image(wrong)
    for number in (0, 65536):
        with pytest.raises(FrameError):
            dl.image_of_number(number)
