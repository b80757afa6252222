"""Decoding of image files to grey: JPEG, PNG and TIFF of any depth and colour, with a note for each conversion.

The format is detected from the content; the suffix is ignored. The declared size is checked before decoding, so that a
small file cannot allocate gigabytes. Rules:

- 8 and 16 bits of grey are kept as they are. A white-is-zero TIFF is inverted.
- Colour becomes grey by ITU-R BT.601: 0.299 R + 0.587 G + 0.114 B, rounded. Palettes are expanded before. RGB with
  three equal channels is grey without a note.
- Pixels are multiplied by their alpha channel: transparent pixels are black.
- 1 bit becomes 0 and 255; 2 and 4 bits are scaled to 8 bits.
- Float, signed and 32-bit samples of a TIFF are scaled from their own minimum..maximum to 0..65535. Samples that are
  not finite become 0.
- Colour PNG of 16 bits and grey PNG of 16 bits with alpha are reduced to 8 bits.
- The orientation of the EXIF data or of the TIFF tag is applied.
- Of a TIFF with several pages the first is used.
"""

from __future__ import annotations

import io
import math
import struct
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt
import tifffile
from PIL import Image

from sonarpost.errors import SurveyFileError
from sonarpost.files import read_regular
from sonarpost.limits import limit

GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
_Pixels = npt.NDArray[Any]
"""Pixels of any type, shape (rows, columns) or (rows, columns, channels)."""

MAX_PIXELS: Final = 1 << 26
"""Enough for a survey of 30,000 pings of 2,000 samples; snippets are much smaller."""
MAX_FILE_BYTES: Final = 1 << 28
MAX_DECODED_BYTES: Final = limit(
    2 * MAX_PIXELS, "bytes", "claims", "image files", "file", "pixels that its header states", "it is refused"
)
MAX_EXPANSION: Final = limit(
    2000, "bytes for each byte", "claims", "image files", "file", "pixels of its header, beyond 1 MiB", "it is refused"
)
EXPECTED: Final = "a JPEG, PNG or TIFF image"

_PNG_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"
_PNG_CHANNELS: Final = {0: 1, 2: 3, 3: 4, 4: 2, 6: 4}
"""Channels by colour type; a palette is expanded."""
_PNG_END: Final = b"IEND\xaeB`\x82"
_JPEG_SIGNATURE: Final = b"\xff\xd8\xff"
_TIFF_SIGNATURES: Final = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
_PALETTE: Final = 3
"""Photometric interpretation of a TIFF with a palette."""
_ORIENTATION_TAG: Final = 0x0112
_COLOUR_NOTE: Final = "colour converted to grey (0.299 R + 0.587 G + 0.114 B)"
_ALPHA_NOTE: Final = "alpha channel applied, transparent pixels are black"
_PALETTE_NOTE: Final = "palette expanded"
_ONE_BIT_NOTE: Final = "1-bit pixels are 0 and 255"
_REDUCED_NOTE: Final = "16 bits with colour or alpha reduced to 8 bits"
_ROWS_AT_ONCE: Final = 256


@dataclass(frozen=True)
class DecodedFile:
    """An image file as grey.

    Attributes:
        pixels: Shape (rows, columns), uint8 or uint16; 0 is black.
        notes: What was converted, one phrase each; empty if the file is grey of 8 or 16 bits.
    """

    pixels: GreyImage
    notes: tuple[str, ...]


def read_any_image(path: Path) -> DecodedFile:
    """Read a JPEG, PNG or TIFF file of any depth and colour as grey.

    Raises:
        SurveyFileError: Not such a file, damaged, truncated, or larger than `MAX_PIXELS` or `MAX_FILE_BYTES`.
    """
    try:
        raw = read_regular(path, MAX_FILE_BYTES)
    except OSError as error:
        raise SurveyFileError(str(path), "", error.strerror or str(error), "a readable image") from error
    if raw.startswith(_PNG_SIGNATURE):
        name, decode = "PNG", _decode_png
    elif raw.startswith(_JPEG_SIGNATURE):
        name, decode = "JPEG", _decode_jpeg
    elif raw.startswith(_TIFF_SIGNATURES):
        name, decode = "TIFF", _decode_tiff
    else:
        raise SurveyFileError(str(path), "signature", raw[:8], EXPECTED)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            pixels, notes = decode(raw, path)
            grey = _grey(pixels, notes)
    except SurveyFileError:
        raise
    except Exception as error:  # a damaged file makes Pillow and tifffile raise nearly anything
        raise SurveyFileError(str(path), f"{name} data", str(error), f"an undamaged {name}") from error
    return DecodedFile(grey, tuple(notes))


def _decode_png(raw: bytes, path: Path) -> tuple[_Pixels, list[str]]:
    if len(raw) < 33 or raw[12:16] != b"IHDR":
        raise SurveyFileError(str(path), "IHDR", raw[8:16], "a PNG header")
    columns, rows, depth, colour = struct.unpack(">IIBB", raw[16:26])
    _check_size(path, rows, columns, max(depth, 8) * _PNG_CHANNELS.get(colour, 4), raw)
    if _PNG_END not in raw:
        # Pillow accepts a file that ends after the last pixel, before the checksum.
        raise SurveyFileError(str(path), "IEND", "absent", "an end chunk: the file is truncated")
    notes = []
    if depth in (2, 4) and colour == 0:
        notes.append(f"{depth}-bit pixels scaled to 8 bits")
    if depth == 16 and colour != 0:
        notes.append(_REDUCED_NOTE)
    with Image.open(io.BytesIO(raw), formats=["PNG"]) as image:
        orientation = image.getexif().get(_ORIENTATION_TAG, 1)
        return _oriented(_pillow_pixels(image, notes), orientation, notes), notes


def _decode_jpeg(raw: bytes, path: Path) -> tuple[_Pixels, list[str]]:
    notes: list[str] = []
    with Image.open(io.BytesIO(raw), formats=["JPEG"]) as image:
        _check_size(path, image.height, image.width, 8 * len(image.getbands()), raw)
        orientation = image.getexif().get(_ORIENTATION_TAG, 1)
        return _oriented(_pillow_pixels(image, notes), orientation, notes), notes


def _decode_tiff(raw: bytes, path: Path) -> tuple[_Pixels, list[str]]:
    notes: list[str] = []
    with tifffile.TiffFile(io.BytesIO(raw)) as file:
        page = file.pages.first
        rows, columns = int(page.imagelength), int(page.imagewidth)
        channels, bits = int(page.samplesperpixel), int(page.bitspersample)
        pixel_bits = max(bits, 8) * (channels if int(page.photometric) != _PALETTE else 3)
        _check_size(path, rows, columns, pixel_bits, raw)
        if page.is_tiled:
            _check_size(path, int(page.tilelength), int(page.tilewidth), pixel_bits, raw)
        if int(page.imagedepth) != 1:
            raise SurveyFileError(str(path), "layout", "a volume", "a two-dimensional image")
        if channels > 4:
            raise SurveyFileError(str(path), "channels", channels, "1 to 4")
        if len(file.pages) > 1:
            notes.append(f"first of {len(file.pages)} pages used")
        orientation = int(page.tags.valueof(_ORIENTATION_TAG, 1))
        try:
            pixels = np.asarray(page.asarray(maxworkers=1))
        except ValueError as error:
            if "imagecodecs" not in str(error):
                raise
            # Compressions that tifffile leaves to another package; libtiff in Pillow has them.
            with Image.open(io.BytesIO(raw), formats=["TIFF"]) as image:
                pixels = _pillow_pixels(image, notes)  # Pillow applies the orientation
            if pixels.dtype not in (np.uint8, np.uint16):
                pixels = _scaled_to_16_bits(pixels, path, notes)
            elif bits == 16 and pixels.dtype == np.uint8:
                notes.append(_REDUCED_NOTE)
            return pixels, notes + _orientation_notes(orientation)
        if channels > 1 and int(page.planarconfig) == 2:
            pixels = np.moveaxis(pixels, 0, -1)
        return _oriented(_tiff_colours(page, pixels, path, notes), orientation, notes), notes


def _tiff_colours(page: tifffile.TiffPage, pixels: _Pixels, path: Path, notes: list[str]) -> _Pixels:
    """Return grey or RGB of 8 or 16 bits, with the alpha channel if there is one."""
    photometric, channels = int(page.photometric), int(page.samplesperpixel)
    if photometric == _PALETTE and channels == 1 and page.colormap is not None:
        notes.append(_PALETTE_NOTE)
        return np.moveaxis((np.asarray(page.colormap) >> 8).astype(np.uint8)[:, pixels], 0, -1)
    # Accepted: white is zero, black is zero, RGB; rejected: masks and print colours.
    if photometric not in ((0, 1) if channels < 3 else (2,)):
        expected = "grey, RGB or a palette"
        raise SurveyFileError(str(path), "PhotometricInterpretation", f"{photometric}, {channels} channels", expected)
    if pixels.dtype == np.bool_:
        notes.append(_ONE_BIT_NOTE)
        pixels = pixels.astype(np.uint8) * np.uint8(255)
    elif pixels.dtype not in (np.uint8, np.uint16):
        pixels = _scaled_to_16_bits(pixels, path, notes)
    if photometric == 0:
        pixels = np.iinfo(pixels.dtype).max - pixels
    if channels in (2, 4) and 2 not in page.extrasamples:
        # Of an associated alpha channel the pixels are products already.
        notes.append(_ALPHA_NOTE if 1 in page.extrasamples else "channel without a meaning ignored")
        pixels = pixels[..., :-1]
    return pixels


def _scaled_to_16_bits(pixels: _Pixels, path: Path, notes: list[str]) -> npt.NDArray[np.uint16]:
    """Scale samples of any real type from their minimum..maximum to 0..65535."""
    if pixels.dtype.kind not in "iuf":
        raise SurveyFileError(str(path), "sample type", str(pixels.dtype), "integer or float")
    low, high = math.inf, -math.inf
    for top in range(0, pixels.shape[0], _ROWS_AT_ONCE):
        part = pixels[top : top + _ROWS_AT_ONCE].astype(np.float64)
        part = part[np.isfinite(part)]
        low, high = min(low, part.min(initial=math.inf)), max(high, part.max(initial=-math.inf))
    if low > high:
        raise SurveyFileError(str(path), "samples", "none that is finite", "an image")
    notes.append(f"{pixels.dtype} samples scaled from {low:g}..{high:g} to 0..65535")
    scaled = np.empty(pixels.shape, np.uint16)
    step = max(high / 65535 - low / 65535, np.finfo(np.float64).tiny)
    for top in range(0, pixels.shape[0], _ROWS_AT_ONCE):
        part = pixels[top : top + _ROWS_AT_ONCE].astype(np.float64)
        part = np.where(np.isfinite(part), part, low)
        scaled[top : top + _ROWS_AT_ONCE] = np.clip(np.rint(part / step - low / step), 0, 65535)
    return scaled


def _pillow_pixels(image: Image.Image, notes: list[str]) -> _Pixels:
    """Decode: shape (rows, columns) or (rows, columns, 2 to 4), the last of 2 or 4 channels being alpha."""
    image.load()
    mode = image.mode
    if mode == "1":
        notes.append(_ONE_BIT_NOTE)
        return np.asarray(image.convert("L"))
    if mode == "P":
        notes.append(_PALETTE_NOTE)
        return np.asarray(image.convert("RGBA" if "transparency" in image.info else "RGB"))
    if mode in ("L", "LA", "RGB", "RGBA", "I", "F"):
        return np.asarray(image)
    if mode.startswith("I;16"):
        return np.asarray(image).astype(np.uint16, copy=False)
    return np.asarray(image.convert("RGB"))  # the print colours of a JPEG


def _orientation_notes(orientation: object) -> list[str]:
    return [f"turned by its orientation tag ({orientation})"] if orientation in range(2, 9) else []


def _oriented(pixels: _Pixels, orientation: object, notes: list[str]) -> _Pixels:
    """Turn and mirror an image so that it is shown upright; orientations that EXIF does not define change nothing."""
    notes += _orientation_notes(orientation)
    if orientation in (5, 6, 7, 8):
        pixels = np.swapaxes(pixels, 0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        pixels = pixels[:, ::-1]
    return pixels


def _grey(pixels: _Pixels, notes: list[str]) -> GreyImage:
    """Return grey of shape (rows, columns), uint8 or uint16, in strips that bound the memory."""
    if pixels.ndim == 2:
        grey: GreyImage = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("="))
        return grey
    full_scale = int(np.iinfo(pixels.dtype).max)
    channels = pixels.shape[2]
    is_colour = channels > 2 and not (pixels[..., :3] == pixels[..., :1]).all()
    notes += [_COLOUR_NOTE] * is_colour + [_ALPHA_NOTE] * (channels in (2, 4))
    grey = np.empty(pixels.shape[:2], pixels.dtype.newbyteorder("="))
    for top in range(0, pixels.shape[0], _ROWS_AT_ONCE):
        strip = pixels[top : top + _ROWS_AT_ONCE].astype(np.uint64)
        level = strip[..., 0]
        if is_colour:
            level = (299 * level + 587 * strip[..., 1] + 114 * strip[..., 2] + 500) // 1000
        if channels in (2, 4):
            level = (level * strip[..., -1] + full_scale // 2) // full_scale
        grey[top : top + _ROWS_AT_ONCE] = level
    return grey


def _check_size(path: Path, rows: int, columns: int, bits: int, raw: bytes) -> None:
    """Check the size that a header states; `bits` is the number for each pixel."""
    if not (rows and columns and rows * columns <= MAX_PIXELS):
        raise SurveyFileError(str(path), "size", f"{columns} × {rows} px", f"1 to {MAX_PIXELS} pixels")
    max_bytes = min(MAX_DECODED_BYTES, MAX_EXPANSION * len(raw) + (1 << 20))
    if rows * columns * bits > 8 * max_bytes:
        raise SurveyFileError(str(path), "size", f"{columns} × {rows} × {bits} bits", f"at most {max_bytes} bytes")
