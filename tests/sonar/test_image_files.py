"""TIFF and PNG files of grey images."""

from __future__ import annotations

import io
import logging
import os
import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.image_files import read_image, write_png, write_tiff

GREY = hnp.arrays(
    st.sampled_from([np.uint8, np.uint16]), hnp.array_shapes(min_dims=2, max_dims=2, max_side=24), fill=st.nothing()
)


def ramp(dtype: type = np.uint8) -> np.ndarray:
    full_scale = np.iinfo(dtype).max
    return np.linspace(0, full_scale, 12 * 20).reshape(12, 20).astype(dtype)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(image=GREY)
def test_both_formats_keep_every_pixel(tmp_path, image):
    for write, name in ((write_tiff, "a.tiff"), (write_png, "a.png")):
        write(tmp_path / name, image)
        read = read_image(tmp_path / name)
        assert read.dtype == image.dtype
        np.testing.assert_array_equal(read, image)


def test_other_libraries_read_written_images(tmp_path):
    for dtype in (np.uint8, np.uint16):
        write_tiff(tmp_path / "a.tiff", ramp(dtype), description="contact 7")
        with tifffile.TiffFile(tmp_path / "a.tiff") as file:
            assert file.pages.first.description == "contact 7"
            assert not {"DateTime", "Software"} & {tag.name for tag in file.pages.first.tags}
        with Image.open(tmp_path / "a.tiff") as image:
            np.testing.assert_array_equal(np.asarray(image), ramp(dtype))
        write_png(tmp_path / "a.png", ramp(dtype))
        with Image.open(tmp_path / "a.png") as image:
            np.testing.assert_array_equal(np.asarray(image), ramp(dtype))


def test_golden_bytes_of_tiff(tmp_path):
    write_tiff(tmp_path / "a.tiff", np.array([[1, 2, 3]], np.uint8))
    raw = (tmp_path / "a.tiff").read_bytes()
    assert raw[:8] == bytes.fromhex("49492a00 08000000")
    assert raw[-3:] == b"\x01\x02\x03"


def test_same_image_gives_same_bytes(tmp_path):
    for write, suffix in ((write_tiff, "tiff"), (write_png, "png")):
        write(tmp_path / f"a.{suffix}", ramp())
        os.utime(tmp_path / f"a.{suffix}", (0, 0))
        write(tmp_path / f"b.{suffix}", ramp().copy(order="F"))
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()


def test_failed_write_keeps_old_file_and_leaves_no_temporary_file(tmp_path, monkeypatch):
    write_tiff(tmp_path / "a.tiff", ramp())
    before = (tmp_path / "a.tiff").read_bytes()

    def disk_full(fd: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", disk_full)
    with pytest.raises(OSError, match="No space left"):
        write_tiff(tmp_path / "a.tiff", ramp()[::-1])
    assert [p.name for p in tmp_path.iterdir()] == ["a.tiff"]
    assert (tmp_path / "a.tiff").read_bytes() == before


@pytest.mark.parametrize(
    ("image", "field"),
    [
        (ramp().astype(np.float32), "depth"),
        (ramp().astype(np.uint32), "depth"),
        (ramp().astype(bool), "depth"),
        (ramp()[None], "shape"),
        (np.zeros((0, 4), np.uint8), "shape"),
    ],
)
def test_only_8_and_16_bit_grey_is_written(tmp_path, image, field):
    for write in (write_tiff, write_png):
        with pytest.raises(SurveyFileError, match=field):
            write(tmp_path / "a", image)
    assert not list(tmp_path.iterdir())


def test_description_must_be_ascii(tmp_path):
    with pytest.raises(SurveyFileError, match="description"):
        write_tiff(tmp_path / "a.tiff", ramp(), description="Øst")


def test_format_is_detected_from_content(tmp_path):
    write_png(tmp_path / "a.tiff", ramp())
    np.testing.assert_array_equal(read_image(tmp_path / "a.tiff"), ramp())


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"tile": (16, 16)}, {"bigtiff": True}])
def test_tiff_with_other_layouts(tmp_path, byteorder, options):
    tifffile.imwrite(tmp_path / "a.tif", ramp(np.uint16), byteorder=byteorder, photometric="minisblack", **options)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), ramp(np.uint16))


def test_white_is_zero_is_inverted(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", ramp(), photometric="miniswhite")
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), 255 - ramp())


@pytest.mark.parametrize("planar", ["contig", "separate"])
def test_rgb_with_equal_channels_is_grey(tmp_path, planar):
    axis = -1 if planar == "contig" else 0
    tifffile.imwrite(tmp_path / "a.tif", np.stack([ramp()] * 3, axis), photometric="rgb", planarconfig=planar)
    np.testing.assert_array_equal(read_image(tmp_path / "a.tif"), ramp())
    Image.fromarray(np.stack([ramp()] * 3, -1)).save(tmp_path / "a.png")
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), ramp())


def pillow_bytes(mode: str) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(ramp()).convert("RGB").convert(mode).save(buffer, format="PNG")
    return buffer.getvalue()


def tiff_bytes(pixels: np.ndarray, **options: object) -> bytes:
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, pixels, **options)
    return buffer.getvalue()


COLOUR = np.stack([ramp(), ramp(), ramp()[::-1]], -1)
UNSUPPORTED = {
    "PNG of 1 bit": (pillow_bytes("1"), "grey of 1 bits"),
    "PNG palette": (pillow_bytes("P"), "palette"),
    "PNG with alpha": (pillow_bytes("LA"), "alpha"),
    "TIFF float": (tiff_bytes(ramp().astype(np.float32)), "float of 32 bits"),
    "TIFF of 32 bits": (tiff_bytes(ramp().astype(np.uint32)), "32 bits"),
    "TIFF signed": (tiff_bytes(ramp().astype(np.int16)), "signed"),
    "TIFF of 1 bit": (tiff_bytes(ramp() > 9, photometric="minisblack"), "1 bits"),
    "TIFF colour": (tiff_bytes(COLOUR, photometric="rgb"), "unequal"),
    "TIFF of two pages": (tiff_bytes(np.stack([ramp()] * 2), photometric="minisblack", metadata=None), "pages"),
    "text": (b"not an image", "signature"),
    "nothing": (b"", "signature"),
}


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_error_names_unsupported_image(tmp_path, name):
    raw, message = UNSUPPORTED[name]
    (tmp_path / "a").write_bytes(raw)
    with pytest.raises(SurveyFileError, match=message):
        read_image(tmp_path / "a")


def test_colour_png_is_rejected(tmp_path):
    Image.fromarray(COLOUR).save(tmp_path / "a.png")
    with pytest.raises(SurveyFileError, match="unequal channels"):
        read_image(tmp_path / "a.png")


def png_with_declared_size(columns: int, rows: int) -> bytes:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    )


def test_declared_size_is_checked_before_decoding(tmp_path):
    (tmp_path / "a.png").write_bytes(png_with_declared_size(2**31 - 1, 2**31 - 1))
    with pytest.raises(SurveyFileError, match="size"):
        read_image(tmp_path / "a.png")
    raw = bytearray(tiff_bytes(ramp(), photometric="minisblack", metadata=None))
    with tifffile.TiffFile(io.BytesIO(raw)) as file:
        offset = file.pages.first.tags["ImageWidth"].offset
    raw[offset : offset + 12] = struct.pack("<HHII", 256, 4, 1, 2**31)
    (tmp_path / "a.tif").write_bytes(raw)
    with pytest.raises(SurveyFileError, match="size"):
        read_image(tmp_path / "a.tif")


@pytest.mark.parametrize("write", [write_tiff, write_png])
def test_every_truncation_raises_survey_file_error(tmp_path, write):
    write(tmp_path / "a", ramp(np.uint16))
    raw = (tmp_path / "a").read_bytes()
    for length in range(0, len(raw), 3):
        (tmp_path / "b").write_bytes(raw[:length])
        with pytest.raises(SurveyFileError):
            read_image(tmp_path / "b")


@settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    png=st.booleans(),
    damage=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=8),
)
def test_damaged_file_is_read_or_raises_survey_file_error(tmp_path, caplog, png, damage):
    caplog.set_level(logging.CRITICAL)
    (write_png if png else write_tiff)(tmp_path / "a", ramp(np.uint16))
    raw = bytearray((tmp_path / "a").read_bytes())
    for offset, value in damage:
        raw[offset % len(raw)] = value
    (tmp_path / "b").write_bytes(raw)
    try:
        image = read_image(tmp_path / "b")
    except SurveyFileError:
        return
    assert image.ndim == 2
    assert image.dtype in (np.uint8, np.uint16)


def test_missing_or_irregular_file_is_rejected(tmp_path):
    with pytest.raises(SurveyFileError, match="absent"):
        read_image(tmp_path / "absent.png")
    with pytest.raises(SurveyFileError, match="absent"):
        read_image(tmp_path)


@pytest.mark.realdata
def test_recorded_images_are_read(data_dir):
    derived: Path = data_dir / "surveys" / "derived"
    assert read_image(derived / "scotsman-iver2.xtf.port.png").dtype == np.uint16
    assert read_image(derived / "000_1236.xtf.stbd.png").shape == (1446, 512)
