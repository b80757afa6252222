"""TIFF and PNG files of grey images."""

import io
import logging
import os
import struct
import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image, ImageOps

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.image_decoding import read_any_image
from sonarpost.sonar.image_files import MAX_UNUSED_LINES, list_images, read_image, write_png, write_tiff

GREY = hnp.arrays(
    st.sampled_from([np.uint8, np.uint16]), hnp.array_shapes(min_dims=2, max_dims=2, max_side=24), fill=st.nothing()
)


def ramp(dtype=np.uint8):
    full_scale = np.iinfo(dtype).max
    return np.linspace(0, full_scale, 12 * 20).reshape(12, 20).astype(dtype)


@given(image=GREY)
def test_both_formats_keep_every_pixel(tmp_path, image):
    for write, name in ((write_tiff, "a.tiff"), (write_png, "a.png")):
        write(tmp_path / name, image)
        read = read_image(tmp_path / name)
        assert read.dtype == image.dtype
        np.testing.assert_array_equal(read, image)


def test_other_libraries_read_written_images(tmp_path):
    write_tiff(tmp_path / "a.tiff", np.array([[1, 2, 3]], np.uint8))
    raw = (tmp_path / "a.tiff").read_bytes()
    assert (raw[:8], zlib.decompress(raw[-11:])) == (bytes.fromhex("49492a00 08000000"), b"\x01\x02\x03")
    for dtype in (np.uint8, np.uint16):
        write_tiff(tmp_path / "a.tiff", ramp(dtype))
        with tifffile.TiffFile(tmp_path / "a.tiff") as file:
            assert not {"DateTime", "Software"} & {tag.name for tag in file.pages.first.tags}
        with Image.open(tmp_path / "a.tiff") as image:
            np.testing.assert_array_equal(np.asarray(image), ramp(dtype))
        write_png(tmp_path / "a.png", ramp(dtype))
        with Image.open(tmp_path / "a.png") as image:
            np.testing.assert_array_equal(np.asarray(image), ramp(dtype))


def test_same_image_gives_same_bytes_and_a_failed_write_keeps_them(tmp_path, monkeypatch):
    for write, suffix in ((write_tiff, "tiff"), (write_png, "png")):
        write(tmp_path / f"a.{suffix}", ramp())
        os.utime(tmp_path / f"a.{suffix}", (0, 0))
        write(tmp_path / f"b.{suffix}", ramp().copy(order="F"))
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()
    before = (tmp_path / "a.tiff").read_bytes()

    def disk_full(fd):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", disk_full)
    with pytest.raises(OSError, match="No space left"):
        write_tiff(tmp_path / "a.tiff", ramp()[::-1])
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "a.tiff", "b.png", "b.tiff"]
    assert (tmp_path / "a.tiff").read_bytes() == before


def test_only_8_and_16_bit_grey_is_written(tmp_path):
    depths = [(ramp().astype(dtype), "depth") for dtype in (np.float32, np.uint32, bool)]
    for image, field in (*depths, (ramp()[None], "shape"), (np.zeros((0, 4), np.uint8), "shape")):
        for write in (write_tiff, write_png):
            with pytest.raises(SurveyFileError, match=field):
                write(tmp_path / "a", image)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"tile": (16, 16)}, {"bigtiff": True}])
def test_tiff_with_other_layouts(tmp_path, byteorder, options):
    """The format is detected from the content, whatever the name."""
    tifffile.imwrite(tmp_path / "a.png", ramp(np.uint16), byteorder=byteorder, photometric="minisblack", **options)
    np.testing.assert_array_equal(read_image(tmp_path / "a.png"), ramp(np.uint16))


def tiff_bytes(pixels, **options):
    buffer = io.BytesIO()
    tifffile.imwrite(buffer, pixels, **options)
    return buffer.getvalue()


COLOUR = np.stack([ramp(), ramp()[:, ::-1], ramp()[::-1]], -1)
ALPHA = np.where(np.arange(20) < 10, 0, 255).astype(np.uint8) * np.ones((12, 1), np.uint8)
GREY_OF_COLOUR = np.rint(COLOUR @ np.array([0.299, 0.587, 0.114])).astype(np.uint8)
HALF_BLACK = np.where(ALPHA == 0, 0, ramp())


def pillow_file(image, kind, **options):
    buffer = io.BytesIO()
    image = image if isinstance(image, Image.Image) else Image.fromarray(image)
    image.save(buffer, format=kind, **options)
    return buffer.getvalue()


def png(columns, rows, bits, colour_type, lines):
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", columns, rows, bits, colour_type, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b"")


def png16(colour_type, pixels):
    """Return a PNG of 16 bits in a colour that Pillow does not write."""
    lines = b"".join(b"\0" + line.astype(">u2").tobytes() for line in pixels)
    return png(pixels.shape[1], len(pixels), 16, colour_type, lines)


def wide(pixels):
    return pixels.astype(np.uint16) * 257


def palette_image():
    image = Image.fromarray((ramp() // 64).astype(np.uint8), mode="P")
    image.putpalette([10, 20, 30, 0, 0, 255, 255, 0, 0, 255, 255, 255])
    return image


PALETTE_GREY = np.array([18, 29, 76, 255], np.uint8)[ramp() // 64]
BITS = (ramp() > 100).astype(np.uint8) * np.uint8(255)
FLOAT = np.where(ramp() == 0, np.nan, ramp() / 7.0 - 3).astype(np.float32)
FLOAT_GREY = np.rint(np.nan_to_num((FLOAT + 3) * 7 - 1) / 254 * 65535).astype(np.uint16)
COLOUR_NOTE, ALPHA_NOTE = "colour converted to grey", "alpha channel"
CLEAR_COLOUR = np.where(ALPHA == 0, 0, GREY_OF_COLOUR)

# Name: bytes, grey pixels, text of the notes (empty: no conversion). None for pixels: JPEG is compared with tolerance.
READABLE: dict[str, tuple[bytes, np.ndarray, str]] = {
    "JPEG grey": (pillow_file(ramp(), "JPEG", quality=95), ramp(), ""),
    "JPEG RGB": (
        pillow_file(np.kron(COLOUR, np.ones((8, 8, 1), np.uint8)), "JPEG", quality=100, subsampling=0),
        np.kron(GREY_OF_COLOUR, np.ones((8, 8), np.uint8)),
        COLOUR_NOTE,
    ),
    "JPEG CMYK": (pillow_file(Image.fromarray(ramp()).convert("CMYK"), "JPEG", quality=100), ramp(), ""),
    "PNG 8": (pillow_file(ramp(), "PNG"), ramp(), ""),
    "PNG 16": (pillow_file(ramp(np.uint16), "PNG"), ramp(np.uint16), ""),
    "PNG 1 bit": (pillow_file(Image.fromarray(BITS).convert("1"), "PNG"), BITS, "1-bit pixels"),
    "PNG RGB": (pillow_file(COLOUR, "PNG"), GREY_OF_COLOUR, COLOUR_NOTE),
    "PNG RGB equal": (pillow_file(np.stack([ramp()] * 3, -1), "PNG"), ramp(), ""),
    "PNG RGBA": (pillow_file(np.dstack([COLOUR, ALPHA]), "PNG"), CLEAR_COLOUR, ALPHA_NOTE),
    "PNG LA": (pillow_file(np.dstack([ramp(), ALPHA]), "PNG"), HALF_BLACK, ALPHA_NOTE),
    "PNG palette": (pillow_file(palette_image(), "PNG", bits=2), PALETTE_GREY, "palette"),
    "PNG palette with a transparent entry": (
        pillow_file(palette_image(), "PNG", transparency=3),
        np.where(PALETTE_GREY == 255, 0, PALETTE_GREY),
        ALPHA_NOTE,
    ),
    "PNG RGB 16": (png16(2, wide(COLOUR)), GREY_OF_COLOUR, "reduced to 8 bits"),
    "PNG RGBA 16": (png16(6, wide(np.dstack([COLOUR, ALPHA * 0 + 255]))), GREY_OF_COLOUR, "reduced to 8 bits"),
    "PNG LA 16": (png16(4, wide(np.dstack([ramp(), ALPHA]))), HALF_BLACK, "reduced to 8 bits"),
    "TIFF 8": (tiff_bytes(ramp()), ramp(), ""),
    "TIFF white is zero": (tiff_bytes(ramp(), photometric="miniswhite"), 255 - ramp(), ""),
    "TIFF RGB equal": (tiff_bytes(np.stack([ramp()] * 3, -1), photometric="rgb"), ramp(), ""),
    "TIFF 16": (tiff_bytes(ramp(np.uint16)), ramp(np.uint16), ""),
    "TIFF 16 LZW": (pillow_file(ramp(np.uint16), "TIFF", compression="tiff_lzw"), ramp(np.uint16), ""),
    "TIFF RGB LZW": (pillow_file(COLOUR, "TIFF", compression="tiff_lzw"), GREY_OF_COLOUR, COLOUR_NOTE),
    "TIFF float LZW": (pillow_file(FLOAT, "TIFF", compression="tiff_lzw"), FLOAT_GREY, "float32 samples scaled"),
    "TIFF 1 bit": (tiff_bytes(BITS > 0, photometric="minisblack"), BITS, "1-bit pixels"),
    "TIFF 1 bit fax": (
        pillow_file(Image.fromarray(BITS).convert("1"), "TIFF", compression="group4"),
        BITS,
        "1-bit pixels",
    ),
    "TIFF RGB": (tiff_bytes(COLOUR, photometric="rgb"), GREY_OF_COLOUR, COLOUR_NOTE),
    "TIFF RGB planes": (
        tiff_bytes(np.moveaxis(COLOUR, -1, 0), photometric="rgb", planarconfig="separate"),
        GREY_OF_COLOUR,
        COLOUR_NOTE,
    ),
    "TIFF RGB 16": (
        tiff_bytes(wide(COLOUR), photometric="rgb"),
        np.rint(wide(COLOUR) @ np.array([0.299, 0.587, 0.114])).astype(np.uint16),
        COLOUR_NOTE,
    ),
    "TIFF grey with alpha": (
        tiff_bytes(
            np.dstack([ramp(), ALPHA]), photometric="minisblack", planarconfig="contig", extrasamples=["unassalpha"]
        ),
        HALF_BLACK,
        ALPHA_NOTE,
    ),
    "TIFF RGBA": (
        tiff_bytes(np.dstack([COLOUR, ALPHA]), photometric="rgb", extrasamples=["unassalpha"]),
        CLEAR_COLOUR,
        ALPHA_NOTE,
    ),
    "TIFF RGB with associated alpha": (
        tiff_bytes(np.dstack([COLOUR, ALPHA]), photometric="rgb", extrasamples=["assocalpha"]),
        GREY_OF_COLOUR,
        ALPHA_NOTE,
    ),
    "TIFF palette": (
        tiff_bytes(
            (ramp() // 64).astype(np.uint8),
            photometric="palette",
            colormap=wide(np.pad(np.array([[10, 20, 30], [0, 0, 255], [255, 0, 0], [255] * 3]).T, ((0, 0), (0, 252)))),
        ),
        PALETTE_GREY,
        "palette",
    ),
    "TIFF float": (tiff_bytes(FLOAT), FLOAT_GREY, "float32 samples scaled from -2.85714..33.4286"),
    "TIFF of 32 bits": (tiff_bytes(ramp().astype(np.uint32) << 20), wide(ramp()), "uint32 samples scaled"),
    "TIFF signed": (tiff_bytes(ramp().astype(np.int16) - 100), wide(ramp()), "int16 samples scaled from -100..155"),
    "TIFF of two pages": (
        tiff_bytes(np.stack([ramp(), ramp()[::-1]]), photometric="minisblack", metadata=None),
        ramp(),
        "first of 2 pages",
    ),
}


@pytest.mark.parametrize("name", READABLE)
def test_every_format_depth_and_colour_is_read_by_one_rule(tmp_path, name):
    raw, pixels, note = READABLE[name]
    (tmp_path / "a").write_bytes(raw)
    image = read_any_image(tmp_path / "a")
    assert image.pixels.dtype in (np.uint8, np.uint16)
    assert image.pixels.dtype.isnative
    tolerance = 12 if name.startswith("JPEG") else int("float" in name)  # float32 rounds before the scaling
    np.testing.assert_allclose(image.pixels.astype(int), pixels.astype(int), atol=tolerance)
    assert note in "; ".join(image.notes)
    if note:
        with pytest.raises(SurveyFileError, match="grey of 8 or 16 bits without conversion"):
            read_image(tmp_path / "a")
    else:
        assert image.notes == ()
        np.testing.assert_array_equal(read_image(tmp_path / "a"), image.pixels)


@given(
    colours=hnp.arrays(
        st.sampled_from([np.uint8, np.uint16]),
        hnp.array_shapes(min_dims=2, max_dims=2, min_side=3, max_side=20).map(lambda shape: (*shape, 3)),
        fill=st.nothing(),
    )
)
def test_grey_of_a_colour_is_its_documented_luminance(tmp_path, colours):
    (tmp_path / "a").write_bytes(tiff_bytes(colours, photometric="rgb", planarconfig="contig"))
    grey = read_any_image(tmp_path / "a").pixels
    assert grey.dtype == colours.dtype
    expected = colours.astype(np.float64) @ np.array([0.299, 0.587, 0.114])
    assert np.abs(grey - expected).max() <= 0.5 + 1e-6


@pytest.mark.parametrize(
    ("kind", "orientation"), [*(("TIFF", value) for value in range(1, 9)), ("JPEG", 6), ("PNG", 5), ("TIFF LZW", 7)]
)
def test_orientation_is_applied_as_other_programs_apply_it(tmp_path, kind, orientation):
    pixels = np.kron(np.array([[0, 80, 160], [250, 30, 120]], np.uint8), np.ones((16, 16), np.uint8))
    exif = Image.Exif()
    exif[0x0112] = orientation
    if kind == "TIFF":
        raw = tiff_bytes(pixels, extratags=[(274, 3, 1, orientation, True)])
    elif kind == "TIFF LZW":
        raw = pillow_file(pixels, "TIFF", compression="tiff_lzw", tiffinfo={274: orientation})
    else:
        raw = pillow_file(pixels, kind, exif=exif)
    (tmp_path / "a").write_bytes(raw)
    image = read_any_image(tmp_path / "a")
    source = Image.fromarray(pixels)
    source.getexif()[0x0112] = orientation
    expected = np.asarray(ImageOps.exif_transpose(source))
    np.testing.assert_allclose(image.pixels.astype(int), expected, atol=6)
    assert image.notes == (() if orientation == 1 else (f"turned by its orientation tag ({orientation})",))


UNSUPPORTED = {
    "TIFF of five channels": (
        tiff_bytes(np.zeros((12, 20, 5), np.uint8), photometric="minisblack", planarconfig="contig"),
        "channels",
    ),
    "TIFF of complex samples": (tiff_bytes(ramp().astype(np.complex64)), "sample type"),
    "TIFF without a finite sample": (tiff_bytes(np.full((12, 20), np.nan, np.float32)), "finite"),
    "TIFF of print colours": (
        tiff_bytes(np.zeros((12, 20, 4), np.uint8), photometric="separated"),
        "PhotometricInterpretation",
    ),
    "GIF": (pillow_file(ramp(), "GIF"), "signature"),
    "text": (b"not an image", "signature"),
    "nothing": (b"", "signature"),
}


@pytest.mark.parametrize("name", UNSUPPORTED)
def test_error_names_unsupported_image(tmp_path, name):
    raw, message = UNSUPPORTED[name]
    (tmp_path / "a").write_bytes(raw)
    with pytest.raises(SurveyFileError, match=message):
        read_any_image(tmp_path / "a")


def test_declared_size_is_checked_before_decoding(tmp_path):
    (tmp_path / "a.png").write_bytes(png(2**31 - 1, 2**31 - 1, 8, 0, bytes(100)))
    with pytest.raises(SurveyFileError, match="size"):
        read_image(tmp_path / "a.png")
    raw = bytearray(tiff_bytes(ramp(), photometric="minisblack", metadata=None))
    with tifffile.TiffFile(io.BytesIO(raw)) as file:
        offset = file.pages.first.tags["ImageWidth"].offset
    raw[offset : offset + 12] = struct.pack("<HHII", 256, 4, 1, 2**31)
    (tmp_path / "a.tif").write_bytes(raw)
    with pytest.raises(SurveyFileError, match="size"):
        read_image(tmp_path / "a.tif")
    jpeg = bytearray(READABLE["JPEG RGB"][0])
    start = jpeg.index(b"\xff\xc0") + 5  # height and width of the frame header
    jpeg[start : start + 4] = struct.pack(">HH", 65535, 65535)
    (tmp_path / "a.jpg").write_bytes(jpeg)
    with pytest.raises(SurveyFileError, match=r"[Ss]ize.*4294836225"):
        read_image(tmp_path / "a.jpg")


@pytest.mark.parametrize("name", ["JPEG RGB", "PNG RGBA", "PNG 16", "TIFF 16", "TIFF palette", "TIFF RGB LZW"])
def test_a_truncated_file_is_refused_or_lacks_no_pixel(tmp_path, name):
    raw = READABLE[name][0]
    (tmp_path / "a").write_bytes(raw)
    whole = read_any_image(tmp_path / "a").pixels
    refused = 0
    for length in range(0, len(raw), 1 + len(raw) // 75):
        (tmp_path / "b").write_bytes(raw[:length])
        try:
            np.testing.assert_array_equal(read_any_image(tmp_path / "b").pixels, whole)
        except SurveyFileError:
            refused += 1
    assert refused > 25


def png_header(columns, rows, depth, colour):
    header = b"IHDR" + struct.pack(">IIBBBBB", columns, rows, depth, colour, 0, 0, 0)
    chunks = [header, b"IDAT" + bytes(1 << 17), b"IEND"]
    framed = (struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    return b"\x89PNG\r\n\x1a\n" + b"".join(framed)


def tiff_header(columns, rows, bits, *others):
    """Return a TIFF of tags only; `others` are tags with a single value."""
    tags = sorted([(256, columns), (257, rows), (258, bits), (259, 1), (262, 1), (277, 1), *others])
    packed = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    return struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + packed + bytes(4)


@pytest.mark.parametrize(
    "raw",
    [
        png_header(8192, 8192, 16, 6),
        png_header(8192, 8192, 1, 3),
        png_header(8192, 8192, 8, 0)[: 1 << 12] + b"IEND\xaeB`\x82",
        tiff_header(8192, 8192, 16, (322, 8192), (323, 8192), (324, 0), (325, 0)),
        tiff_header(16, 16, 16, (322, 8192), (323, 8192), (324, 0), (325, 0)),
        tiff_header(8192, 4096, 64, (339, 3), (273, 8), (278, 4096), (279, 64)),
    ],
    ids=["RGBA of 16 bits", "palette of 1 bit", "little data", "absent tile", "tile larger than image", "float64"],
)
def test_pixels_without_data_are_refused_before_decoding(raw, tmp_path):
    (tmp_path / "a").write_bytes(raw)
    tracemalloc.start()
    with pytest.raises(SurveyFileError, match=r"size: got '.* bits', expected at most"):
        read_any_image(tmp_path / "a")
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 4 * len(raw) + (1 << 21)


@given(
    name=st.sampled_from(sorted(READABLE)),
    damage=st.lists(st.tuples(st.integers(0, 10**6), st.integers(0, 255)), min_size=1, max_size=8),
)
def test_damaged_file_is_read_or_raises_survey_file_error(tmp_path, caplog, name, damage):
    caplog.set_level(logging.CRITICAL)
    raw = bytearray(READABLE[name][0])
    for offset, value in damage:
        raw[offset % len(raw)] = value
    (tmp_path / "b").write_bytes(raw)
    try:
        image = read_any_image(tmp_path / "b").pixels
    except SurveyFileError:
        return
    assert image.ndim == 2
    assert image.dtype in (np.uint8, np.uint16)


def test_folder_lists_images_side_cars_and_what_is_not_used(tmp_path):
    for name in ("b.PNG", "a.jpg", "c.tiff", ".hidden.png", "phone.HEIC", "a.txt", "other.txt"):
        (tmp_path / name).write_bytes(b"x")
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "d.jpeg").write_bytes(b"x")
    (tmp_path / "streams").mkdir()
    found = list_images(tmp_path, ignore=[tmp_path / "streams"])
    assert [path.name for path in found.images] == ["a.jpg", "b.PNG", "c.tiff"]
    assert [path.name for path in found.side_cars] == ["a.txt"]
    assert found.unused == (
        f"{tmp_path}/.hidden.png: not used: hidden",
        f"{tmp_path}/more: not used: a folder, not searched",
        f"{tmp_path}/other.txt: not used: not a JPEG, PNG or TIFF image",
        f"{tmp_path}/phone.HEIC: not used: not a JPEG, PNG or TIFF image",
    )
    deep = list_images(tmp_path, recursive=True)
    assert [path.name for path in deep.images] == ["a.jpg", "b.PNG", "c.tiff", "d.jpeg"]
    assert not any("a folder" in line for line in deep.unused)
    for number in range(MAX_UNUSED_LINES):
        (tmp_path / f"{number}.heic").write_bytes(b"x")
    unused = list_images(tmp_path).unused
    assert f"{tmp_path}: 11 not used (.heic): not a JPEG, PNG or TIFF image" in unused
    assert len(unused) == 4


def test_folder_without_an_image_is_an_error_that_names_its_files(tmp_path):
    (tmp_path / "phone.heic").write_bytes(b"x")
    for folder, message in ((tmp_path, r"got 0, expected .* \(only phone\.heic\)"), (tmp_path / "n", "no such folder")):
        with pytest.raises(SurveyFileError, match=message):
            list_images(folder)

    for path, message in ((tmp_path / "absent.png", "No such file"), (tmp_path, "not a regular file")):
        with pytest.raises(SurveyFileError, match=message):
            read_image(path)


@pytest.mark.realdata
def test_recorded_images_are_read(data_dir):
    derived: Path = data_dir / "surveys" / "derived"
    assert read_image(derived / "scotsman-iver2.xtf.port.png").dtype == np.uint16
    assert read_image(derived / "000_1236.xtf.stbd.png").shape == (1446, 512)
