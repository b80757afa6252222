"""Records: valid and invalid values of each field, and conversion of images to and from arrays."""

import hashlib

import numpy as np
import pytest
from builders.record_samples import COMPLETE_IMAGE, DAMAGED_IMAGE, FULL_CONTACT, RECORD_TYPES, SAMPLES
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pydantic import ValidationError

from sonarpost.errors import BadInputError
from sonarpost.messages import Command, Contact, Pixels, ReconstructedImage, Record, VehicleStatus

# Values that the checks of a record reject: those that depend on another field.
RANGES = [((0, 17),), ((4, 4),), ((5, 4),), ((8, 9), (1, 2)), ((1, 3), (3, 5))]
PIECES = [((3, b"x"),), ((4, b""),), ((20, b"x"), (19, b"y")), ((20, b"xy"), (21, b"z")), ((29, b"xy"),)]
INVALID = {
    "raster": {"data": [b"", b"12345", b"1234567"]},
    "transmission": {"end_utc_s": [1476262801.0, 1476263102.0]},
    "received_image": {"missing": RANGES},
    "part": {
        "b": [3, 4],
        "p": [b"x" * 31],
        "s": PIECES,
        "m": [((0, 31),), *RANGES[1:]],
        "a": [b"x", bytes(15), bytes(17)],
    },
    "reconstructed_image": {"pixels_sha256": ["0" * 64], "missing_mask": [b"12", b"123456"]},
    "contact": {"p_other_object": [0.2501, None]},
    "command": {"image_id": [None], "box": [(8, 0, 8, 32), (0, 9, 8, 9)]},
    "received_status": {"status": [{"vehicle_id": "uuv-9", "time_utc_s": 1.0}]},
}
EXAMPLE = {type(sample): sample for sample in SAMPLES.values()} | {
    type(SAMPLES[name]): SAMPLES[name] for name in ("contact-classified", "raster-8-bits", "vehicle-status-full")
}
EXAMPLE[Command] = Command(**(SAMPLES["command-revisit"].model_dump() | {"kind": "refine", "image_id": "00A7"}))
EXAMPLE[ReconstructedImage] = COMPLETE_IMAGE


def changed(record_type, **change):
    return record_type(**(EXAMPLE[record_type].model_dump() | change))


def refused(record_type, **change):
    """Return the names of the invalid fields, the first one first."""
    try:
        changed(record_type, **change)
    except ValidationError as error:
        return [each["loc"][0] for each in error.errors()]
    return []


@pytest.mark.parametrize("record_type", [t for t in RECORD_TYPES if t.TYPE in INVALID], ids=lambda t: t.TYPE)
def test_value_that_contradicts_another_field_is_rejected(record_type):
    for name, values in INVALID[record_type.TYPE].items():
        assert not refused(record_type)
        for value in values:
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
