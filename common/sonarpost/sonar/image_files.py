"""Grey image files: TIFF as the record, PNG for display.

Only grey of 8 or 16 bits is accepted. The declared size is checked before decoding, so that a small file cannot
allocate gigabytes.
"""

from __future__ import annotations

import io
import struct
import warnings
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
import tifffile
from PIL import Image

from sonarpost.errors import SurveyFileError
from sonarpost.files import write_atomically

GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]

MAX_PIXELS: Final = 1 << 26
"""Enough for a survey of 30,000 pings of 2,000 samples; snippets are much smaller."""
MAX_FILE_BYTES: Final = 1 << 28

_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_PNG_END: Final = b"IEND\xaeB`\x82"
_TIFF_SIGNATURES: Final = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
_DEPTH_EXPECTED: Final = "grey of 8 or 16 bits"
_PNG_COLOURS: Final = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGB with alpha"}


def read_image(path: Path) -> GreyImage:
    """Read a grey image, TIFF or PNG by its content (the suffix is ignored).

    RGB of 8 or 16 bits with three equal channels is read as grey. A TIFF of several pages, an alpha channel, a
    palette, float, 1-bit or 32-bit samples are rejected.

    Returns:
        Shape (rows, columns), uint8 or uint16 as in the file; 0 is black (a white-is-zero TIFF is inverted).

    Raises:
        SurveyFileError: Not a readable grey image.
    """
    try:
        if not path.is_file():
            raise SurveyFileError(str(path), "", "not a regular file or absent", "a TIFF or PNG image")
        size_bytes = path.stat().st_size
        if size_bytes > MAX_FILE_BYTES:
            raise SurveyFileError(str(path), "file size", size_bytes, f"at most {MAX_FILE_BYTES} bytes")
        raw = path.read_bytes()
    except OSError as error:
        raise SurveyFileError(str(path), "", error.strerror or str(error), "a readable image") from error
    if raw.startswith(_PNG_SIGNATURE):
        return _grey(_read_png(raw, path), path)
    if raw.startswith(_TIFF_SIGNATURES):
        return _grey(_read_tiff(raw, path), path)
    raise SurveyFileError(str(path), "signature", raw[:8], "a TIFF or PNG image")


def write_tiff(path: Path, image: GreyImage, description: str | None = None) -> None:
    """Write a grey image as uncompressed TIFF, atomically. The same image and description give the same bytes.

    The image has shape (rows, columns), uint8 or uint16. The description, ASCII, is that of the TIFF tag.

    Raises:
        SurveyFileError: Another shape or depth, or a description that is not ASCII.
        OSError: The file cannot be written.
    """
    write_atomically(path, tiff_bytes(path, image, description))


def tiff_bytes(path: Path, image: GreyImage, description: str | None = None) -> bytes:
    """Return the bytes that `write_tiff` writes; `path` is for error messages only.

    Raises:
        SurveyFileError: Another shape or depth, or a description that is not ASCII.
    """
    _check_writable(path, image)
    if description is not None and not description.isascii():
        raise SurveyFileError(str(path), "description", description, "ASCII text")
    buffer = io.BytesIO()
    tifffile.imwrite(
        buffer,
        image,
        byteorder="<",
        photometric="minisblack",
        compression=None,
        software=False,  # a version number would make the bytes depend on the installation
        datetime=None,
        metadata=None,
        description=description,
    )
    return buffer.getvalue()


def write_png(path: Path, image: GreyImage) -> None:
    """Write a grey image as PNG, atomically, without dates.

    The image has shape (rows, columns), uint8 or uint16.

    Raises:
        SurveyFileError: Another shape or depth.
        OSError: The file cannot be written.
    """
    write_atomically(path, png_bytes(path, image))


def png_bytes(path: Path, image: GreyImage) -> bytes:
    """Return the bytes that `write_png` writes; `path` is for error messages only.

    Raises:
        SurveyFileError: Another shape or depth.
    """
    _check_writable(path, image)
    return encode_png(Image.fromarray(np.ascontiguousarray(image)))


def encode_png(image: Image.Image) -> bytes:
    """Return an image of Pillow as PNG, without dates."""
    buffer = io.BytesIO()
    image.save(buffer, format="PNG")
    return buffer.getvalue()


def _check_writable(path: Path, image: GreyImage) -> None:
    if image.dtype not in (np.uint8, np.uint16):
        raise SurveyFileError(str(path), "depth", str(image.dtype), "uint8 or uint16")
    if image.ndim != 2 or 0 in image.shape:
        raise SurveyFileError(str(path), "shape", image.shape, "rows and columns, both at least 1")


def _read_png(raw: bytes, path: Path) -> npt.NDArray[np.generic]:
    """Check the IHDR chunk, then decode: Pillow converts 1, 2 and 4 bits silently."""
    if len(raw) < 33 or raw[12:16] != b"IHDR":
        raise SurveyFileError(str(path), "IHDR", raw[8:16], "a PNG header")
    columns, rows, depth, colour = struct.unpack(">IIBB", raw[16:26])
    if depth not in (8, 16) or colour not in (0, 2):
        found = f"{_PNG_COLOURS.get(colour, f'colour type {colour}')} of {depth} bits"
        raise SurveyFileError(str(path), "depth", found, _DEPTH_EXPECTED)
    if colour == 2 and depth == 16:
        # Pillow would silently drop the low byte.
        raise SurveyFileError(str(path), "depth", "RGB of 16 bits", _DEPTH_EXPECTED)
    _check_size(path, rows, columns)
    if _PNG_END not in raw:
        # Pillow accepts a file that ends after the last pixel, before the checksum.
        raise SurveyFileError(str(path), "IEND", "absent", "an end chunk: the file is truncated")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(raw), formats=["PNG"]) as image:
                image.load()
                pixels = np.asarray(image)
    except Exception as error:  # Pillow raises OSError, SyntaxError, ValueError, struct.error, ...
        raise SurveyFileError(str(path), "PNG data", str(error), "an undamaged PNG") from error
    return pixels if depth == 8 else pixels.astype(np.uint16)


def _read_tiff(raw: bytes, path: Path) -> npt.NDArray[np.generic]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with tifffile.TiffFile(io.BytesIO(raw)) as file:
                return _tiff_page(file, path)
    except SurveyFileError:
        raise
    except Exception as error:  # a damaged TIFF makes tifffile raise nearly anything
        raise SurveyFileError(str(path), "TIFF data", str(error), "an undamaged TIFF") from error


def _tiff_page(file: tifffile.TiffFile, path: Path) -> npt.NDArray[np.generic]:
    page = file.pages.first
    bits, kind, channels = int(page.bitspersample), int(page.sampleformat), int(page.samplesperpixel)
    if bits not in (8, 16) or kind != 1 or channels not in (1, 3):
        names = {1: "unsigned integer", 2: "signed integer", 3: "float"}
        found = f"{channels} x {names.get(kind, f'sample format {kind}')} of {bits} bits"
        raise SurveyFileError(str(path), "depth", found, _DEPTH_EXPECTED)
    photometric = int(page.photometric)
    # Accepted: white is zero, black is zero, RGB; rejected: palettes, masks and print colours.
    if photometric not in ((0, 1) if channels == 1 else (2,)):
        raise SurveyFileError(str(path), "PhotometricInterpretation", photometric, _DEPTH_EXPECTED)
    rows, columns = int(page.imagelength), int(page.imagewidth)
    _check_size(path, rows, columns)
    if int(page.imagedepth) != 1 or (page.is_tiled and int(page.tilewidth) * int(page.tilelength) > MAX_PIXELS):
        raise SurveyFileError(str(path), "layout", "a volume or a giant tile", "a two-dimensional image")
    if len(file.pages) != 1:
        raise SurveyFileError(str(path), "pages", len(file.pages), "one")
    pixels = np.asarray(page.asarray(maxworkers=1))
    if channels == 3 and pixels.shape == (3, rows, columns):
        pixels = np.moveaxis(pixels, 0, -1)
    if photometric == 0:
        pixels = np.iinfo(pixels.dtype).max - pixels
    return pixels


def _check_size(path: Path, rows: int, columns: int) -> None:
    if not (rows and columns and rows * columns <= MAX_PIXELS):
        raise SurveyFileError(str(path), "size", f"{columns} x {rows}", f"1 to {MAX_PIXELS} pixels")


def _grey(pixels: npt.NDArray[np.generic], path: Path) -> GreyImage:
    if pixels.ndim == 3 and pixels.shape[2] == 3:
        if not ((pixels[..., 0] == pixels[..., 1]).all() and (pixels[..., 0] == pixels[..., 2]).all()):
            raise SurveyFileError(str(path), "colour", "RGB with unequal channels", _DEPTH_EXPECTED)
        pixels = pixels[..., 0]
    if pixels.ndim != 2:
        raise SurveyFileError(str(path), "shape", pixels.shape, "rows and columns")
    if pixels.dtype.itemsize == 1:
        return np.ascontiguousarray(pixels, dtype=np.uint8)
    return np.ascontiguousarray(pixels, dtype=np.uint16)
