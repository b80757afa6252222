"""Records: valid and invalid values of each field, and conversion of images to and from arrays."""

from __future__ import annotations

import hashlib
import math

import numpy as np
import pytest
from builders.record_samples import COMPLETE_IMAGE, DAMAGED_IMAGE, FULL_CONTACT, RECORD_TYPES, SAMPLES
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pydantic import ValidationError

from sonarpost.errors import BadInputError
from sonarpost.messages import Command, Contact, Pixels, ReconstructedImage, Record, VehicleStatus

NAN, INF = math.nan, math.inf


def between(low, high, step=0.1):
    """Return the limits of a range, and values outside of it."""
    outside = [low - step, high + step]
    return [low, high], outside if isinstance(step, int) else [*outside, NAN, INF, -INF]


def text(low, high, unit="x"):
    return [unit * low, unit * high], [*([unit * (low - 1)] if low else []), unit * (high + 1)]


NAMES = ["a", "u" * 32, "0-v"], ["", "UUV", "uuv_1", "-uuv", "uuv/1", "u" * 33, "uuv\n", "*"]
IMAGE_ID = ["0001", "ZZZZ"], ["", "001", "00001", "00a7", "00 7", "00A\n"]
ID = ["!", "~" * 64], ["", "x" * 65, "two words", "ünïcode", "tab\t", "\x7f"]
SHA = ["0" * 64, "f" * 64], ["0" * 63, "0" * 65, "G" * 64, "A" * 64]
HASH = ["", "0a" * 32], ["0" * 63, "G" * 64]
TIME = [0.0, 253402300799.0], [-0.001, 253402300800.0, NAN, INF]
COUNT, FROM_1 = between(0, 2**63 - 1, 1), between(1, 2**63 - 1, 1)
METRES, FRACTION, SIDE = between(0, 20000), between(0, 1), between(1, 512, 1)
PIXEL = [1e-9, 100], [0.0, 100.1, NAN]
RANGES = [(), ((0, 14),)], [((0, 17),), ((4, 4),), ((5, 4),), ((8, 9), (1, 2)), ((1, 3), (3, 5))]
ANY = [], []
RASTER = SAMPLES["raster-16-bits"]

# Valid and invalid values of the correct type by field; then those of names with another meaning.
LIMITS = {
    "contact_id": text(1, 120), "vehicle_id": NAMES, "vessel_id": NAMES, "platform_id": NAMES, "image_id": IMAGE_ID,
    "sonar_id": text(0, 2000), "line_name": text(0, 2000), "position_note": text(0, 2000),
    "source": text(0, 2000), "detail": text(0, 2000),
    "reason": text(0, 2000), "remark": text(0, 2000), "mlo_class": text(0, 60), "atd_class": text(0, 60),
    "message_id": ID, "decision_id": ID, "record_id": ID, "command_id": ID, "comment_id": ID, "withdraws": ID,
    "service": text(1, 40), "key": text(1, 300), "operator": text(1, 120), "author": text(1, 120),
    "issued_by": text(1, 120), "channel": (["port", "starboard"], ["", "Port", "nadir"]),
    "verdict": (["mine_like", "not_mine_like", "unsure"], ["", "MINE_LIKE", "maybe"]), "codec": text(0, 40),
    "model": HASH, "original_sha256": SHA, "pixels_sha256": ([], [*SHA[1], "0" * 64]), "version": FROM_1,
    "image_version": FROM_1, "lat_deg": between(-90, 90), "lon_deg": between(-180, 180),
    "depth_m": between(-100, 12000), "heading_deg": ([0, 359.9], [-0.1, 360.0, NAN]), "speed_mps": between(-50, 50),
    "atd_confidence": between(0, 2), "pixel_along_m": PIXEL, "pixel_across_m": PIXEL,
    "p_mine_like": ([0, 0.8], [-0.1, 1.1, NAN]), "p_other_object": ([0, 0.25], [-0.1, 1.1, NAN, 0.2501, None]),
    "height_px": SIDE, "width_px": SIDE, "bits": ([8], [0, 1, 32]), "confidence": FRACTION,
    "frame_loss": FRACTION, "battery": FRACTION, "missing_fraction": FRACTION, "despeckle_strength": FRACTION,
    "rate": between(0, 255, 1), "missing": RANGES,
    "missing_halves": ([("bottom",), ("top", "bottom")], [("left",), ("top", "TOP")]),
    "missing_mask": ([b"", b"1"], [b"12", b"123456"]), "stream": ([bytes(65542)], [bytes(65543)]),
    "notes": ([("x" * 2000,)], [("x" * 2001,)]), "state": ([], ["", "OK", "lost"]),
    "kind": ([], ["", "sink", "comments"]), "authenticated": ANY, "complete": ANY, "contact": ANY, "pixels": ANY,
    "wide": ANY, "quality": ANY, "payload": ANY, "snr_in_db": ([], [NAN, INF]), "snr_out_db": ([], [NAN]),
    "spl_db": ([], [NAN]), "mse_db": ([], [-INF]), "doppler": ([], [NAN]),
    "direction": (["tx", "rx"], ["", "RX", "both"]), "destination": between(0, 255, 1),
    "frame_number": between(1, 255, 1), "frame_count": between(0, 255, 1),
    "airtime_s": ([1e-9, 600], [0.0, -1.0, 600.1]), "priority": between(1, 7, 1),
    "lifetime_s": ([1e-9, 604800], [0.0, 604800.1, NAN]), "packet_interval_s": between(0, 86400),
    "travel_s": between(0, 100), "sound_speed_mps": between(1300, 1700), "distance_m": between(0, 170_000),
    "pixels_crc32": between(0, 2**32 - 1, 1), "overrules": ([("d",) * 16], [("",), ("d",) * 17]),
    "box": ([(0, 0, 32, 32)], [(-1, 0, 4, 4), (0, 0, 33, 4), (8, 0, 8, 32), (0, 9, 8, 9)]),
    "stream_bytes": between(24, 65535, 1), "place": (["first", "last"], ["", "second"]),
    "counters": ([{"n": 0}, {"n": 2**63 - 1}], [{"n": -1}, {"n": 2**63}]), "gauges": ([], [{"n": NAN}, {"n": -INF}]),
    "status": ([], [{"vehicle_id": "uuv-9", "time_utc_s": 1.0}]),
    "transmissions": ([], [(SAMPLES["transmission"],) * 1001, ({"start_utc_s": 2.0, "end_utc_s": 1.0},)]),
    "images": ([(SAMPLES["queued-image"],) * 500], [(SAMPLES["queued-image"],) * 501]),
}  # fmt: skip
OWN_LIMITS = {
    "raster": {"data": ([], [b"", b"12345", b"1234567"]), "height_px": ([], [0, 4097]), "width_px": ([], [0, 4097])},
    "acoustic_frame": {"data": ([b"", bytes(2048)], [bytes(2049)]), "source": between(0, 255, 1)},
    "outgoing_message": {"data": ([b"x", bytes(1024)], [b"", bytes(1025)]), "source": text(1, 40)},
    "received_message": {"data": ([b"x", bytes(4096)], [b"", bytes(4097)])},
    "encoded_image": {"codec": text(1, 40), "stream": ([b"12", bytes(65542)], [b"", b"1", bytes(65543)])},
    "coded_image": {"model": (["", "0a" * 16], ["0" * 31, "0" * 64, "G" * 32])},
    "command": {"image_id": ([], [None, *IMAGE_ID[1]])},
    "transmission": {"end_utc_s": ([1476262801.25, 1476263101.25], [*TIME[1], 1476262801.0, 1476263102.0])},
    "part": {
        "u": NAMES, "i": IMAGE_ID, "n": ([2, 2**63 - 1], [0, 2**63]), "b": ([0, 2], [-1, 3, 4]), "t": TIME, "d": COUNT,
        "l": TIME, "c": ([bytes(20_000)], [bytes(20_001)]), "h": SIDE, "w": SIDE, "z": ([30, 65542], [-1, 65543]),
        "p": ([bytes(30)], [b"x" * 31, b"x" * 65543]), "k": between(0, 2**32 - 1, 1), "f": COUNT,
        "x": between(0, 2**32 - 1, 1),
        "s": (
            [((4, b"x"), (5, b"y")), ((29, b"x"),)],
            [((3, b"x"),), ((4, b""),), ((20, b"x"), (19, b"y")), ((20, b"xy"), (21, b"z")), ((29, b"xy"),)],
        ),
        "m": ([((0, 30),)], [((0, 31),), *RANGES[1][1:]]), "e": COUNT, "y": COUNT, "q": COUNT, "g": between(0, 31, 1),
        "a": ([b"", bytes(16)], [b"x", bytes(15), bytes(17)]),
    },
}  # fmt: skip
EXAMPLE = {type(sample): sample for sample in SAMPLES.values()} | {
    type(SAMPLES[name]): SAMPLES[name] for name in ("contact-classified", "raster-8-bits", "vehicle-status-full")
}
EXAMPLE[Command] = Command(**(SAMPLES["command-revisit"].model_dump() | {"kind": "refine", "image_id": "00A7"}))
EXAMPLE[ReconstructedImage] = COMPLETE_IMAGE


def limits_of(record_type, name):
    own = OWN_LIMITS.get(record_type.TYPE, {})
    if name in own or name in LIMITS:
        return own.get(name) or LIMITS[name]
    unit = name.rpartition("_")[2]
    return {"m": METRES, "s": TIME}.get(unit if name.endswith(("_m", "_utc_s")) else "", COUNT)


def changed(record_type, **change):
    return record_type(**(EXAMPLE[record_type].model_dump() | change))


def refused(record_type, **change):
    """Return the names of the invalid fields, the first one first."""
    try:
        changed(record_type, **change)
    except ValidationError as error:
        return [each["loc"][0] for each in error.errors()]
    return []


@pytest.mark.parametrize("record_type", RECORD_TYPES, ids=lambda t: t.TYPE)
def test_every_field_accepts_its_limits_and_rejects_values_outside(record_type):
    for name in record_type.model_fields:
        valid, invalid = limits_of(record_type, name)
        for value in valid:  # it may contradict another field, which is the one to be refused
            assert name not in refused(record_type, **{name: value}), (name, value)
        for value in invalid:
            assert refused(record_type, **{name: value})[:1] == [name], (name, value)


def test_records_are_immutable_and_nothing_but_integers_for_floats_is_converted():
    assert all(record_type.model_config == Record.model_config for record_type in RECORD_TYPES)
    for change in ({"lat_deg": "41"}, {"lat_deg": True}, {"ping_number": 1.0}, {"contact_id": b"c"}, {"contact_id": 1}):
        with pytest.raises(ValidationError):
            changed(Contact, **change)
    assert isinstance(changed(Contact, lat_deg=41).lat_deg, float)
    with pytest.raises(ValidationError, match="frozen"):
        FULL_CONTACT.lat_deg = 1.0


def test_position_of_a_vehicle_has_latitude_and_longitude_or_neither():
    for given_fields in ({"lat_deg": 1.0}, {"lon_deg": 1.0}):
        with pytest.raises(ValidationError, match="a value together with lat_deg, or neither"):
            VehicleStatus(vehicle_id="uuv-1", time_utc_s=0.0, **given_fields)


@pytest.mark.parametrize(("mine_like", "other"), [(0.5, 0.5), (1.0, 0.0), (0.7, 0.3), (0.0, 0.0), (0.6, 0.4 + 1e-9)])
def test_probabilities_of_a_contact_add_up_to_at_most_1(mine_like, other):
    contact = Contact(contact_id="c", vehicle_id="uuv-1", p_mine_like=mine_like, p_other_object=other)
    assert (contact.p_mine_like, contact.p_other_object) == (mine_like, other)
    with pytest.raises(ValidationError, match=r"at most|less than or equal to 1"):
        Contact(contact_id="c", vehicle_id="uuv-1", p_mine_like=mine_like, p_other_object=1.001 - mine_like)
    for name in ("p_mine_like", "p_other_object"):
        with pytest.raises(ValidationError, match="a value together with p_mine_like, or neither"):
            Contact.model_validate({"contact_id": "c", "vehicle_id": "uuv-1", name: mine_like})


def test_samples_cover_every_record_type():
    def subclasses(of):
        direct = {t for t in of.__subclasses__() if t.__module__.startswith("sonarpost.messages.")}
        return direct | {deeper for t in direct for deeper in subclasses(t)}

    assert {type(sample) for sample in SAMPLES.values()} == set(RECORD_TYPES) == subclasses(Record)
    assert len({t.TYPE for t in RECORD_TYPES}) == len(RECORD_TYPES)


@pytest.mark.parametrize("text", ["\ud800", "a\udcffb"])
def test_text_that_utf8_cannot_encode_is_rejected(text):
    with pytest.raises(ValidationError):
        changed(Contact, contact_id=text)


# Images

images = st.one_of(
    *(
        hnp.arrays(dtype, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9))
        for dtype in ("u1", "<u2", ">u2")
    )
)


@given(images)
def test_pixels_round_trip(image):
    raster = Pixels.from_array(image)
    back = raster.to_array()
    assert back.dtype == (np.uint8 if image.dtype.itemsize == 1 else np.uint16)
    assert back.dtype.isnative
    np.testing.assert_array_equal(back, image)
    assert raster.sha256 == hashlib.sha256(raster.data).hexdigest()
    back[0, 0] ^= 1  # a copy that the caller owns
    np.testing.assert_array_equal(raster.to_array(), image)


def test_pixels_are_row_major_and_little_endian():
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
def test_array_that_is_not_an_image_is_rejected(image):
    with pytest.raises(BadInputError, match="expected rows and columns of uint8 or uint16"):
        Pixels.from_array(image)


@pytest.mark.parametrize("shape", [(0, 4), (4, 0), (4097, 1), (1, 4097)])
def test_array_of_an_invalid_size_is_rejected(shape):
    with pytest.raises(ValidationError):
        Pixels.from_array(np.zeros(shape, np.uint8))


@given(hnp.arrays(np.bool_, hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=11)))
def test_mask_marks_the_missing_pixels(missing):
    pixels = Pixels.from_array(np.zeros(missing.shape, np.uint8))
    fields = COMPLETE_IMAGE.model_dump() | {
        "pixels": pixels,
        "pixels_sha256": pixels.sha256,
        "missing_mask": np.packbits(missing).tobytes(),
    }
    np.testing.assert_array_equal(ReconstructedImage(**fields).missing(), missing)


def test_first_bit_of_a_mask_is_the_first_pixel():
    assert DAMAGED_IMAGE.missing_mask == b"\xa8"
    assert DAMAGED_IMAGE.missing().tolist() == [[True, False, True], [False, True, False]]
    assert COMPLETE_IMAGE.missing().tolist() == [[False] * 3] * 2


def test_error_names_the_digest_of_another_image():
    with pytest.raises(ValidationError) as caught:
        changed(ReconstructedImage, pixels=RASTER)
    assert caught.value.errors()[0]["loc"] == ("pixels_sha256",)
    assert RASTER.sha256 in str(caught.value)
    assert changed(ReconstructedImage, pixels=RASTER, pixels_sha256=RASTER.sha256)


@pytest.mark.parametrize(
    ("kind", "given_fields", "missing"),
    [
        ("refine", {}, "image_id"),
        ("resend", {"lat_deg": 1.0, "lon_deg": 1.0}, "image_id"),
        ("expand", {"lat_deg": 1.0, "lon_deg": 1.0}, "image_id"),
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
def test_error_names_the_missing_argument_of_a_command(kind, given_fields, missing):
    common = {"command_id": "c", "kind": kind, "vehicle_id": "uuv-1", "issued_by": "op", "issued_utc_s": 0.0}
    with pytest.raises(ValidationError) as caught:
        Command(**common, **given_fields)
    assert caught.value.errors()[0]["loc"] == (missing,)
