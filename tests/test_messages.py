"""Records: valid and invalid values of each field, and conversion of images to and from arrays."""

from __future__ import annotations

import hashlib
import math
from typing import Any

import numpy as np
import pytest
from builders.record_samples import COMPLETE_IMAGE, DAMAGED_IMAGE, RASTER_8, RASTER_16, RECORD_TYPES, SAMPLES
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pydantic import ValidationError

from sonarpost.errors import BadInputError
from sonarpost.messages import Command, Contact, ImagePart, Pixels, ReconstructedImage, Record, VehicleStatus

NAN, INF = math.nan, math.inf
LONG = "x" * 2001
NO_TIME = [-0.001, 253402300800.0, NAN, INF]
NO_NAME = ["", "UUV", "uuv_1", "-uuv", "uuv/1", "u" * 33, "uuv\n", "*"]
NO_SHA = ["", "0" * 63, "0" * 65, "G" * 64, "A" * 64]
NO_METRES = [-0.1, 20000.1, NAN, -INF]
NO_COUNT = [-1, 2**63]
NO_IMAGE = ["", "001", "00001", "00a7", "00 7", "00A\n"]
NO_ID = ["", "x" * 65, "two words", "ünïcode", "tab\t", "\x7f"]

# For every field with a restricted range: invalid values of the correct type.
OUT_OF_RANGE: dict[type[Record], dict[str, list[object]]] = {
    SAMPLES["contact-classified"].__class__: {
        "contact_id": ["", "x" * 121],
        "vehicle_id": NO_NAME,
        "sonar_id": [LONG],
        "line_name": [LONG],
        "ping_number": NO_COUNT,
        "channel": ["", "Port", "nadir"],
        "time_utc_s": NO_TIME,
        "lat_deg": [-90.1, 90.1, NAN],
        "lon_deg": [-180.1, 180.1, INF],
        "position_sigma_m": NO_METRES,
        "depth_m": [-100.1, 12000.1, NAN],
        "altitude_m": NO_METRES,
        "heading_deg": [-0.1, 360.0, NAN],
        "speed_mps": [-50.1, 50.1, NAN],
        "slant_range_m": NO_METRES,
        "ground_range_m": NO_METRES,
        "atd_class": ["x" * 61],
        "atd_confidence": [-0.1, 2.01, NAN],
        "length_m": NO_METRES,
        "width_m": NO_METRES,
        "shadow_m": NO_METRES,
        "height_m": NO_METRES,
        "pixel_along_m": [0.0, 100.1, NAN],
        "pixel_across_m": [0.0, 100.1, NAN],
        "p_mine_like": [-0.1, 1.1, NAN],
        "p_other_object": [-0.1, 1.1, NAN, 0.2501, None],
    },
    SAMPLES["raster-8-bits"].__class__: {
        "height_px": [0, -1, 4097],
        "width_px": [0, -1, 4097],
        "bits": [0, 1, 32],
        "data": [b"", b"12345", b"1234567"],
    },
    SAMPLES["snippet-classified"].__class__: {"source": [LONG]},
    SAMPLES["encoded-image-unclassified"].__class__: {
        "vehicle_id": NO_NAME,
        "image_id": NO_IMAGE,
        "codec": ["", "x" * 41],
        "model": ["0" * 63, "G" * 64],
        "height_px": [0, 4097],
        "width_px": [0, 4097],
        "stream": [b"", b"1", b"x" * 65544],
        "original_sha256": NO_SHA,
    },
    SAMPLES["link-quality-full"].__class__: {
        **{name: [NAN, INF, -INF] for name in ("snr_in_db", "snr_out_db", "spl_db", "mse_db", "doppler")},
        "frames": NO_COUNT,
        "bad_frames": NO_COUNT,
    },
    SAMPLES["acoustic-frame-received-2"].__class__: {
        "direction": ["", "RX", "both"],
        "platform_id": NO_NAME,
        "time_utc_s": NO_TIME,
        "source": [-1, 256],
        "destination": [-1, 256],
        "rate": [-1, 256],
        "packet": NO_COUNT,
        "frame_number": [0, 256],
        "frame_count": [-1, 256],
        "data": [b"x" * 2049],
        "airtime_s": [0.0, -1.0, 601.0, NAN],
    },
    SAMPLES["received-image-classified"].__class__: {
        "vessel_id": NO_NAME,
        "vehicle_id": NO_NAME,
        "image_id": NO_IMAGE,
        "version": [0, *NO_COUNT],
        "height_px": [0, 4097],
        "width_px": [0, 4097],
        "stream": [b"x" * 65543],
        "missing": [((0, 17),), ((4, 4),), ((5, 4),), ((8, 9), (1, 2)), ((1, 3), (3, 5))],
        "missing_halves": [("left",), ("top", "TOP")],
        "bytes_received": NO_COUNT,
        "bytes_total": NO_COUNT,
        "frames_received": NO_COUNT,
        "conflicts": NO_COUNT,
        "first_frame_utc_s": NO_TIME,
        "last_frame_utc_s": NO_TIME,
    },
    SAMPLES["coded-image"].__class__: {
        "vessel_id": NO_NAME,
        "vehicle_id": NO_NAME,
        "image_id": NO_IMAGE,
        "version": [0, *NO_COUNT],
        "height_px": [0, 4097],
        "width_px": [0, 4097],
        "stream": [b"x" * 65543],
        "missing": [((0, 17),), ((4, 4),), ((5, 4),), ((8, 9), (1, 2)), ((1, 3), (3, 5))],
        "missing_halves": [("left",), ("top", "TOP")],
        "bytes_received": NO_COUNT,
        "bytes_total": NO_COUNT,
        "frames_received": NO_COUNT,
        "conflicts": NO_COUNT,
        "first_frame_utc_s": NO_TIME,
        "last_frame_utc_s": NO_TIME,
        "codec": ["x" * 41],
        "model": ["0" * 31, "0" * 64, "G" * 32],
        "picture_crc32": [-1, 1 << 32],
    },
    SAMPLES["part-difference"].__class__: {
        "u": NO_NAME,
        "i": NO_IMAGE,
        "n": [0, *NO_COUNT],
        "b": [3, 4, *NO_COUNT],
        "t": NO_TIME,
        "d": NO_COUNT,
        "l": NO_TIME,
        "c": [b"x" * 20_001],
        "h": [0, 4097],
        "w": [0, 4097],
        "z": [-1, 65543],
        "p": [b"x" * 31, b"x" * 65543],
        "s": [((3, b"x"),), ((4, b""),), ((20, b"x"), (19, b"y")), ((29, b"xy"),)],
        "m": [((0, 31),), ((4, 4),), ((5, 4),), ((8, 9), (1, 2)), ((1, 3), (3, 5))],
        "k": [-1, 1 << 32],
        "x": [-1, 1 << 32],
        "f": NO_COUNT,
        "e": NO_COUNT,
        "y": NO_COUNT,
        "q": NO_COUNT,
        "g": [-1, 32],
        "a": [b"x", b"x" * 15, b"x" * 17],
    },
    SAMPLES["reconstructed-image-classified"].__class__: {
        "vessel_id": NO_NAME,
        "vehicle_id": NO_NAME,
        "image_id": NO_IMAGE,
        "version": [0, *NO_COUNT],
        "codec": ["x" * 41],
        "model": ["0" * 63, "G" * 64],
        "picture_sha256": [*NO_SHA, "0" * 64],
        "missing_fraction": [-0.1, 1.1, NAN],
        "missing_mask": [b"12", b"123456"],
        "missing_halves": [("left",), ("top", "TOP")],
        "bytes_received": NO_COUNT,
        "bytes_total": NO_COUNT,
        "frames_received": NO_COUNT,
        "first_frame_utc_s": NO_TIME,
        "last_frame_utc_s": NO_TIME,
        "notes": [(LONG,)],
        "despeckle_strength": [-0.1, 1.1, NAN],
    },
    SAMPLES["outgoing-message"].__class__: {
        "message_id": NO_ID,
        "source": ["", "x" * 41],
        "priority": [0, 8],
        "lifetime_s": [0.0, 604801.0, NAN],
        "created_utc_s": NO_TIME,
        "data": [b"", b"x" * 1025],
    },
    SAMPLES["received-message-authenticated"].__class__: {
        "vessel_id": NO_NAME,
        "vehicle_id": NO_NAME,
        "received_utc_s": NO_TIME,
        "data": [b"", b"x" * 4097],
    },
    SAMPLES["downlink-state-asked"].__class__: {
        "vessel_id": NO_NAME,
        "vehicle_id": NO_NAME,
        "kind": ["", "Refine", "advice"],
        "record_id": NO_ID,
        "state": ["", "Sent", "delivered"],
        "times_sent": NO_COUNT,
        "expires_utc_s": NO_TIME,
        "changed_utc_s": NO_TIME,
        "reason": [LONG],
    },
    SAMPLES["queued-image"].__class__: {
        "image_id": NO_IMAGE,
        "contact_id": ["", "x" * 121],
        "bytes_left": NO_COUNT,
        "preview_utc_s": NO_TIME,
        "expected_utc_s": NO_TIME,
    },
    SAMPLES["queue-state-counting-2"].__class__: {
        "platform_id": NO_NAME,
        "time_utc_s": NO_TIME,
        "rate": [-1, 256],
        "frame_loss": [-0.1, 1.1, NAN],
        "packet_interval_s": [-0.1, 86401.0, NAN],
        "messages_waiting": NO_COUNT,
        "message_bytes": NO_COUNT,
        "images_waiting": NO_COUNT,
        "images": [tuple(SAMPLES["queued-image"].model_dump() for _ in range(501))],
        "images_accepted": NO_COUNT,
    },
    SAMPLES["decision-withdrawal"].__class__: {
        "decision_id": NO_ID,
        "vessel_id": NO_NAME,
        "vehicle_id": NO_NAME,
        "image_id": NO_IMAGE,
        "image_version": [0, *NO_COUNT],
        "verdict": ["", "MINE_LIKE", "maybe"],
        "confidence": [-0.1, 1.1, NAN],
        "mlo_class": ["x" * 61],
        "remark": [LONG],
        "operator": ["", "x" * 121],
        "decided_utc_s": NO_TIME,
        "withdraws": ["", "x" * 65],
        "overrules": [("",), ("d",) * 17],
    },
    SAMPLES["command-to-refine"].__class__: {
        "command_id": NO_ID,
        "kind": ["", "sink"],
        "vehicle_id": NO_NAME,
        "image_id": [None, *NO_IMAGE],
        "lat_deg": [-90.1, 90.1, NAN],
        "lon_deg": [-180.1, 180.1, NAN],
        "issued_by": ["", "x" * 121],
        "issued_utc_s": NO_TIME,
        "box": [(-1, 0, 4, 4), (0, 0, 33, 4), (8, 0, 8, 32), (0, 9, 8, 8)],
        "stream_bytes": [23, 65536],
        "place": ["", "second"],
    },
    SAMPLES["advice-full"].__class__: {
        "advice_id": NO_ID,
        "vessel_id": NO_NAME,
        "vehicle_id": NO_NAME,
        "image_id": NO_IMAGE,
        "image_version": [0, *NO_COUNT],
        "verdict": ["", "MINE_LIKE", "maybe"],
        "confidence": [-0.1, 1.1, NAN],
        "mlo_class": ["x" * 61],
        "remark": [LONG],
        "author": ["", "x" * 121],
        "advised_utc_s": NO_TIME,
    },
    SAMPLES["tasking-state-refused"].__class__: {
        "vessel_id": NO_NAME,
        "kind": ["", "decision"],
        "record_id": NO_ID,
        "state": ["", "lost"],
        "reason": [LONG],
        "changed_utc_s": NO_TIME,
    },
    SAMPLES["relayed"].__class__: {
        "vessel_id": NO_NAME,
        "key": ["", "x" * 301],
        "relayed_utc_s": NO_TIME,
    },
    SAMPLES["health"].__class__: {
        "platform_id": NO_NAME,
        "service": ["", "x" * 41],
        "time_utc_s": NO_TIME,
        "started_utc_s": NO_TIME,
        "state": ["", "OK"],
        "detail": [LONG],
        "counters": [{"n": -1}, {"n": 2**63}],
        "gauges": [{"n": NAN}, {"n": -INF}],
    },
    SAMPLES["transmission"].__class__: {
        "start_utc_s": NO_TIME,
        "end_utc_s": [*NO_TIME, 1476262801.0, 1476263102.0],
    },
    SAMPLES["transmissions"].__class__: {
        "platform_id": NO_NAME,
        "time_utc_s": NO_TIME,
        "transmissions": [(SAMPLES["transmission"],) * 1001, ({"start_utc_s": 2.0, "end_utc_s": 1.0},)],
    },
    SAMPLES["vehicle-status-full"].__class__: {
        "vehicle_id": NO_NAME,
        "time_utc_s": NO_TIME,
        "lat_deg": [-90.1, 90.1, NAN],
        "lon_deg": [-180.1, 180.1, NAN],
        "heading_deg": [-0.1, 360.0, NAN],
        "speed_mps": [-50.1, 50.1, NAN],
        "depth_m": [-100.1, 12000.1, NAN],
        "altitude_m": NO_METRES,
        "swath_m": NO_METRES,
        "battery": [-0.1, 1.1, NAN],
        "images_waiting": NO_COUNT,
        "disk_free_bytes": NO_COUNT,
    },
    SAMPLES["received-status"].__class__: {
        "vessel_id": NO_NAME,
        "vehicle_id": NO_NAME,
        "received_utc_s": NO_TIME,
        "status": [{"vehicle_id": "uuv-9", "time_utc_s": 1476262800.0}],
    },
    SAMPLES["vehicle-range"].__class__: {
        "vessel_id": NO_NAME,
        "vehicle_id": NO_NAME,
        "measured_utc_s": NO_TIME,
        "travel_s": [-0.1, 100.1, NAN],
        "sound_speed_mps": [1299.9, 1700.1, NAN],
        "distance_m": [-0.1, 170_000.1, NAN],
    },
}
# Fields that accept every value of their type, or that are records themselves.
ANY_VALUE = {
    ("snippet", "contact"),
    ("snippet", "picture"),
    ("snippet", "wide"),
    ("encoded_image", "contact"),
    ("acoustic_frame", "quality"),
    ("received_image", "contact"),
    ("coded_image", "contact"),
    ("coded_image", "complete"),
    ("coded_image", "authenticated"),
    ("received_image", "complete"),
    ("reconstructed_image", "contact"),
    ("reconstructed_image", "picture"),
    ("reconstructed_image", "complete"),
    ("received_image", "authenticated"),
    ("received_message", "authenticated"),
    ("reconstructed_image", "authenticated"),
    ("relayed", "payload"),
    ("received_status", "authenticated"),
}

EXAMPLE = {type(sample): sample for sample in reversed(SAMPLES.values())}
EXAMPLE[Command] = Command(**(SAMPLES["command-to-revisit"].model_dump() | {"kind": "refine", "image_id": "00A7"}))
FIELDS = [(t, name) for t in RECORD_TYPES for name in t.model_fields]


def changed(record_type: type[Record], **change: object) -> Record:
    return record_type(**(EXAMPLE[record_type].model_dump() | change))


def label(value: object) -> str:
    return value.TYPE if isinstance(value, type) else str(value)


@pytest.mark.parametrize(("mine_like", "other"), [(0.5, 0.5), (1.0, 0.0), (0.7, 0.3), (0.0, 0.0), (0.6, 0.4 + 1e-9)])
def test_probabilities_of_a_contact_add_up_to_at_most_1(mine_like: float, other: float) -> None:
    contact = Contact(contact_id="c", vehicle_id="uuv-1", p_mine_like=mine_like, p_other_object=other)
    assert (contact.p_mine_like, contact.p_other_object) == (mine_like, other)
    with pytest.raises(ValidationError, match=r"at most|less than or equal to 1"):
        Contact(contact_id="c", vehicle_id="uuv-1", p_mine_like=mine_like, p_other_object=1.001 - mine_like)


@pytest.mark.parametrize("given", ["p_mine_like", "p_other_object"])
def test_one_probability_alone_is_rejected(given: str) -> None:
    with pytest.raises(ValidationError, match="a value together with p_mine_like, or neither"):
        Contact.model_validate({"contact_id": "c", "vehicle_id": "uuv-1", given: 0.5})


def test_samples_cover_every_record_type() -> None:
    def subclasses(of: type[Record]) -> set[type[Record]]:
        direct = {t for t in of.__subclasses__() if t.__module__.startswith("sonarpost.messages.")}
        return direct | {deeper for t in direct for deeper in subclasses(t)}

    assert set(RECORD_TYPES) == subclasses(Record)
    assert len({t.TYPE for t in RECORD_TYPES}) == len(RECORD_TYPES)


@pytest.mark.parametrize(("record_type", "name"), FIELDS, ids=label)
def test_field_rejects_values_out_of_range(record_type: type[Record], name: str) -> None:
    if (record_type.TYPE, name) in ANY_VALUE:
        assert name not in OUT_OF_RANGE[record_type]
        return
    for value in OUT_OF_RANGE[record_type][name]:
        with pytest.raises(ValidationError) as caught:
            changed(record_type, **{name: value})
        assert caught.value.errors()[0]["loc"][0] == name, value


WRONG_TYPES: list[object] = [None, True, 1, 1.5, "text", b"bytes", (1,), {"a": 1}, {1: "a"}]


@pytest.mark.parametrize(("record_type", "name"), FIELDS, ids=label)
def test_field_rejects_values_of_another_type(record_type: type[Record], name: str) -> None:
    """The valid type is that of the sample; None is valid if the annotation allows it. An integer is valid for a float,
    no other conversion exists."""
    right = type(getattr(EXAMPLE[record_type], name))
    nullable = type(None) in getattr(record_type.model_fields[name].annotation, "__args__", ())
    for value in WRONG_TYPES:
        if type(value) is right or (value is None and nullable) or (right is float and type(value) is int):
            continue
        if isinstance(value, dict) and issubclass(right, (Record, dict)):
            continue  # the maps have the correct type; their content is tested elsewhere
        with pytest.raises(ValidationError) as caught:
            changed(record_type, **{name: value})
        assert caught.value.errors()[0]["loc"][0] == name, value


@pytest.mark.parametrize(("record_type", "name"), FIELDS, ids=label)
def test_field_without_a_default_is_required(record_type: type[Record], name: str) -> None:
    fields = EXAMPLE[record_type].model_dump()
    if record_type is ImagePart and name == "z":
        fields["m"] = ()  # ranges behind the last piece, whose end is the default of the length
    if record_type is VehicleStatus and name in ("lat_deg", "lon_deg"):
        fields["lat_deg"] = fields["lon_deg"] = None  # a position has both
    del fields[name]
    if record_type.model_fields[name].is_required():
        with pytest.raises(ValidationError) as caught:
            record_type(**fields)
        assert caught.value.errors()[0]["loc"] == (name,)
    elif record_type is not Command and name not in ("p_mine_like", "p_other_object"):
        default = getattr(record_type(**fields), name)
        assert default is None or default in ("", b"", 0, ()) or (record_type, name) == (ImagePart, "g")


@pytest.mark.parametrize("sample", SAMPLES.values(), ids=SAMPLES)
def test_records_are_immutable(sample: Record) -> None:
    name = next(iter(type(sample).model_fields))
    with pytest.raises(ValidationError, match="frozen"):
        setattr(sample, name, getattr(sample, name))


@pytest.mark.parametrize("text", ["\ud800", "a\udcffb"])
def test_text_that_utf8_cannot_encode_is_rejected(text: str) -> None:
    with pytest.raises(ValidationError):
        changed(Contact, contact_id=text)


# Images

pictures = st.one_of(
    *(
        hnp.arrays(dtype, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9))
        for dtype in ("u1", "<u2", ">u2")
    )
)


@given(pictures)
def test_pixels_round_trip(image: Any) -> None:
    raster = Pixels.from_array(image)
    back = raster.to_array()
    assert back.dtype == (np.uint8 if image.dtype.itemsize == 1 else np.uint16)
    assert back.dtype.isnative
    np.testing.assert_array_equal(back, image)
    assert raster.sha256 == hashlib.sha256(raster.data).hexdigest()
    back[0, 0] ^= 1  # a copy that the caller owns
    np.testing.assert_array_equal(raster.to_array(), image)


def test_pixels_are_row_major_and_little_endian() -> None:
    image = np.array([[1, 2], [0x1234, 0xFFFE]], dtype=">u2")
    assert Pixels.from_array(image).data == bytes.fromhex("0100 0200 3412 feff")
    assert Pixels.from_array(image.T).data == bytes.fromhex("0100 3412 0200 feff")
    assert Pixels.from_array(np.arange(12, dtype=np.uint8).reshape(3, 4)[::2, ::-2]).data == bytes([3, 1, 11, 9])


@pytest.mark.parametrize(
    "image",
    [
        np.ones((2, 2)),
        np.ones((2, 2), np.float32),
        np.ones((2, 2), np.int16),
        np.ones((2, 2), np.uint32),
        np.ones((2, 2), np.bool_),
        np.ones(4, np.uint8),
        np.ones((2, 2, 1), np.uint8),
        np.uint8(1).reshape(()),
    ],
    ids=lambda image: f"{image.dtype}-{image.ndim}d",
)
def test_array_that_is_not_an_image_is_rejected(image: Any) -> None:
    with pytest.raises(BadInputError, match="expected rows and columns of uint8 or uint16"):
        Pixels.from_array(image)


@pytest.mark.parametrize("shape", [(0, 4), (4, 0), (4097, 1), (1, 4097)])
def test_array_of_an_invalid_size_is_rejected(shape: tuple[int, int]) -> None:
    with pytest.raises(ValidationError):
        Pixels.from_array(np.zeros(shape, np.uint8))


@given(hnp.arrays(np.bool_, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=11)))
def test_mask_marks_the_missing_pixels(missing: Any) -> None:
    picture = Pixels.from_array(np.zeros(missing.shape, np.uint8))
    fields = COMPLETE_IMAGE.model_dump() | {
        "picture": picture,
        "picture_sha256": picture.sha256,
        "missing_mask": np.packbits(missing).tobytes(),
    }
    np.testing.assert_array_equal(ReconstructedImage(**fields).missing(), missing)


def test_first_bit_of_a_mask_is_the_first_pixel() -> None:
    assert DAMAGED_IMAGE.missing_mask == b"\xa8"
    assert DAMAGED_IMAGE.missing().tolist() == [[True, False, True], [False, True, False]]
    assert COMPLETE_IMAGE.missing().tolist() == [[False] * 3] * 2


def test_error_names_the_digest_of_another_image() -> None:
    with pytest.raises(ValidationError) as caught:
        changed(ReconstructedImage, picture=RASTER_16)
    assert caught.value.errors()[0]["loc"] == ("picture_sha256",)
    assert RASTER_16.sha256 in str(caught.value)
    assert changed(ReconstructedImage, picture=RASTER_16, picture_sha256=RASTER_16.sha256)
    assert RASTER_16.sha256 != RASTER_8.sha256


@pytest.mark.parametrize(
    ("kind", "given_fields", "missing"),
    [
        ("refine", {}, "image_id"),
        ("resend", {"lat_deg": 1.0, "lon_deg": 1.0}, "image_id"),
        ("wider", {"lat_deg": 1.0, "lon_deg": 1.0}, "image_id"),
        ("original", {"lat_deg": 1.0, "lon_deg": 1.0}, "image_id"),
        ("region", {"image_id": "0001", "stream_bytes": 192}, "box"),
        ("region", {"image_id": "0001", "box": (4, 0, 4, 32), "stream_bytes": 192}, "box"),
        ("region", {"image_id": "0001", "box": (0, 0, 32, 32)}, "stream_bytes"),
        ("prioritise", {"image_id": "0001"}, "place"),
        ("prioritise", {"place": "first"}, "image_id"),
        ("revisit", {"lon_deg": 1.0}, "lat_deg"),
        ("revisit", {"lat_deg": 1.0}, "lon_deg"),
        ("revisit", {"image_id": "0001"}, "lat_deg"),
    ],
)
def test_error_names_the_missing_argument_of_a_command(
    kind: str, given_fields: dict[str, object], missing: str
) -> None:
    common = {"command_id": "c", "kind": kind, "vehicle_id": "uuv-1", "issued_by": "op", "issued_utc_s": 0.0}
    with pytest.raises(ValidationError) as caught:
        Command(**common, **given_fields)
    assert caught.value.errors()[0]["loc"] == (missing,)
