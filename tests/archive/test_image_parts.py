"""Coded images on thin links: whole records, differences, and what a site refuses."""

import msgpack
import pytest
from builders.record_samples import ACOUSTIC_CONTACT
from builders.record_strategies import coded_images
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import wire
from sonarpost.archive.image_parts import coded_image, difference, expand, head_of, stream_of, whole_part
from sonarpost.errors import MissingBaseError, PayloadError
from sonarpost.link.frames.contact_record import RECORD_SIZE, ContactSummary, contact_of
from sonarpost.messages import CodedImage, Contact, ImagePart

SUMMARY = ContactSummary.unpack(ACOUSTIC_CONTACT)


def image(stream, version=1, missing=(), **changes):
    """Return an image of `emb` as op_modem and decompressor describe it."""
    zeroed = bytearray(stream)
    for start, stop in missing:
        zeroed[start:stop] = bytes(stop - start)
    received = len(stream) - sum(stop - start for start, stop in missing)
    fields = {
        "vessel_id": "vessel-1",
        "vehicle_id": "uuv-1",
        "image_id": "000A",
        "version": version,
        "contact": contact_of(SUMMARY, "uuv-1", "000A"),
        "height_px": SUMMARY.height_px,
        "width_px": SUMMARY.width_px,
        "stream": bytes(zeroed),
        "missing": missing,
        "missing_halves": (),
        "complete": False,
        "bytes_received": received,
        "bytes_total": 600,
        "frames_received": 6,
        "conflicts": 0,
        "first_frame_utc_s": 1764000000.123456,
        "last_frame_utc_s": 1764000003.654321 + version,
        "authenticated": True,
        "codec": "emb",
        "model": "",
        "pixels_crc32": 0xDEADBEEF,
    }
    return CodedImage.model_validate(fields | changes)


def noise(length):
    """Return the header of an emb stream and bytes that do not repeat."""
    return b"\x20\x01\x10" + bytes((7 * n * n + 13 * n + n // 256) % 251 + 1 for n in range(length - 3))


def decoded(part):
    """Return a record as its receiver reads it."""
    return wire.decode(ImagePart, wire.encode(part), "key")


@given(sent=coded_images())
def test_every_image_arrives_unchanged(sent):
    arrived = coded_image(decoded(whole_part(sent)), sent.vessel_id, "key")
    zeroed = bytearray(sent.stream)
    for start, stop in sent.missing:
        zeroed[start:stop] = bytes(stop - start)
    halves = tuple(half for half in ("top", "bottom") if half in sent.missing_halves)
    expected = {"stream": bytes(zeroed), "missing_halves": halves, "codec": arrived.codec}
    assert arrived == sent.model_copy(update=expected)


@pytest.mark.parametrize("names", [{"vehicle_id": "uuv-2"}, {"contact_id": "uuv-2/000A"}], ids=str)
def test_contact_with_names_of_another_image_arrives_unchanged(names):
    """Its contact record would be exact, but a site reads the vehicle and the image from the record around it."""
    sent = image(noise(200), contact=contact_of(SUMMARY, "uuv-1", "000A").model_copy(update=names))
    assert coded_image(decoded(whole_part(sent)), sent.vessel_id, "key") == sent
    sent = image(noise(200), vehicle_id="uuv-2")
    assert coded_image(decoded(whole_part(sent)), sent.vessel_id, "key") == sent


@pytest.mark.parametrize("size", [{}, {"height_px": None, "width_px": None}], ids=["size", "no-size"])
def test_contact_with_a_map_as_long_as_a_contact_record_arrives_unchanged(size):
    contact = Contact(contact_id="uuv-1/000A", vehicle_id="uuv-1", sonar_id="14 characters.")
    assert len(msgpack.packb({"sonar_id": contact.sonar_id})) == RECORD_SIZE
    sent = image(noise(200), contact=contact, **size)
    assert coded_image(decoded(whole_part(sent)), sent.vessel_id, "key") == sent


def test_image_whose_contact_is_too_long_is_refused():
    contact = Contact(
        contact_id="c",
        vehicle_id="uuv-1",
        sonar_id="\U0001f6a2" * 2000,
        line_name="\U0001f6a2" * 2000,
        position_note="\U0001f6a2" * 2000,
    )
    with pytest.raises(PayloadError, match="part: c: "):
        whole_part(image(noise(200), contact=contact))


@given(data=st.data(), length=st.integers(3, 900), more=st.integers(0, 900))
def test_difference_to_any_earlier_version_gives_the_whole(data, length, more):
    stream = noise(length + more)

    def missing(size):
        bounds = sorted(data.draw(st.sets(st.integers(3, size), max_size=6)))
        return tuple(zip(bounds[::2], bounds[1::2], strict=False))

    first, second = (
        whole_part(image(stream[:length], 1, missing(length))),
        whole_part(image(stream, 2, missing(len(stream)))),
    )
    assert expand(decoded(difference(second, first)), first, "key") == second
    # Applied to a later version that has arrived in between.
    third = whole_part(image(stream, 3))
    assert expand(decoded(difference(second, first)), third, "key") == second


def test_size_of_a_contact_with_200_bytes():
    """225 bytes are received acoustically: the stream and the contact record."""
    assert len(wire.encode(whole_part(image(noise(200))))) <= 301


@pytest.mark.parametrize("missing", [(), ((250, 282),), ((200, 232), (300, 332))])
def test_difference_costs_the_new_bytes_and_at_most_115_more(missing):
    first, second = whole_part(image(noise(200))), whole_part(image(noise(400), 2, missing))
    new = 200 - sum(stop - start for start, stop in missing)
    assert len(wire.encode(difference(second, first))) <= new + 115


def test_later_contact_and_changed_bytes_are_in_the_difference():
    first = whole_part(image(noise(200), contact=None, height_px=None, width_px=None))
    second = whole_part(image(noise(232), 2))
    assert expand(decoded(difference(second, first)), first, "key") == second
    other = bytearray(noise(200))
    other[100:110] = b"0123456789"
    first, second = whole_part(image(noise(200))), whole_part(image(bytes(other), 2))
    sent = difference(second, first)
    assert len(wire.encode(sent)) < 130
    assert stream_of(expand(sent, first, "key")) == bytes(other)


def test_difference_without_its_base_or_to_another_image_is_refused():
    first, second, third = (whole_part(image(noise(200 + 50 * n), n)) for n in (1, 2, 3))
    sent = difference(third, second)
    with pytest.raises(MissingBaseError, match="key: b: got 2, expected a version that this site has; send the whole"):
        expand(sent, None, "key")
    with pytest.raises(MissingBaseError, match="key: b: got 2"):
        expand(sent, first, "key")
    other = whole_part(image(bytes(reversed(noise(250)))))
    with pytest.raises(MissingBaseError, match="key: k: got"):
        expand(difference(second, first), other, "key")


@pytest.mark.parametrize(
    "change",
    [
        {"c": bytes(24)},
        {"c": b"\x7f" * 25},
        {"c": msgpack.packb({"lat_deg": 91.0})},
        {"c": msgpack.packb([1])},
        {"z": 300},
        {"m": ((0, 4),)},
    ],
    ids=["length", "codes", "range", "no map", "hole", "both"],
)
def test_invalid_whole_image_is_refused(change):
    part = ImagePart.model_validate(whole_part(image(noise(200))).model_dump() | change)
    with pytest.raises(PayloadError):
        coded_image(part, "vessel-1", "key")


def test_versions_of_an_image_have_one_name():
    names = {head_of(wire.encode(whole_part(image(noise(200 + n), n)))).subject for n in (1, 2)}
    assert names == {"uuv-1/000A/1764000000.123456"}
