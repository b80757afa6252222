"""The two side-scan channels of a Humminbird recording, as the shipped codebooks are built from them.

Layout of a channel, as found in the recording that comes with the source distribution of PyHum 1.4.6 and checked ping
by ping there: `B002.IDX` holds (time, offset) pairs, u32 big endian, one a ping; at each offset of `B002.SON` a header
of 67 bytes begins with C0 DE AB 21 and ends with the tag A0, the number of samples (u32, big endian) and the byte 21;
the samples follow, one byte each, nearest first. B002 looks to port, B003 to starboard.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sonarpost.codec.vq.patches import SonarLine
from sonarpost.errors import CodebookError
from sonarpost.sonar.image_files import read_image

CHANNELS = ("B002", "B003")

_START = b"\xc0\xde\xab\x21"
_HEADER_BYTES = 67
_COUNT = struct.Struct(">BIB")  # the last six bytes of the header
_MAX_SAMPLES = 1 << 16


def humminbird_lines(folder: Path) -> dict[str, SonarLine]:
    """Read both channels, from the recording itself or from images made of it.

    Args:
        folder: Holds, directly or in one of its folders, `B002.SON` and `B002.IDX`, or else one grey PNG with `B002`
            in its name (row = ping, column = sample); the same for `B003`.

    Returns:
        Name to line, shape (pings, samples), float32; NaN beyond the end of a ping. The recording and an image of it
        give the same lines.

    Raises:
        CodebookError: A channel is not there, or the recording is damaged.
        SurveyFileError: An image cannot be read.
    """
    return {f"humminbird {channel}": _without_padding(_channel(folder, channel)) for channel in CHANNELS}


def read_channel(son: Path) -> npt.NDArray[np.uint8]:
    """Read one channel of a recording.

    Args:
        son: The `.SON` file; its `.IDX` file lies beside it.

    Returns:
        Shape (pings, samples of the longest), uint8, zeros after the end of a shorter ping.

    Raises:
        CodebookError: A file cannot be read or is damaged; the message names the ping.
    """
    data, index = _read(son), _read(son.with_suffix(".IDX"))
    if len(index) % 8 or not index:
        raise CodebookError(str(son.with_suffix(".IDX")), "length", f"{len(index)} B", "8 B for each ping")
    offsets = np.frombuffer(index, dtype=">u4")[1::2].tolist()
    pings = [_ping(data, offset, f"{son} ping {number}") for number, offset in enumerate(offsets)]
    image = np.zeros((len(pings), max(ping.size for ping in pings)), dtype=np.uint8)
    for row, ping in zip(image, pings, strict=True):
        row[: ping.size] = ping
    return image


def _ping(data: bytes, offset: int, where: str) -> npt.NDArray[np.uint8]:
    header = data[offset : offset + _HEADER_BYTES]
    if len(header) < _HEADER_BYTES or not header.startswith(_START):
        raise CodebookError(where, "header", header[:8], f"{_HEADER_BYTES} B that begin with C0 DE AB 21")
    tag, count, end = _COUNT.unpack(header[-_COUNT.size :])
    if (tag, end) != (0xA0, 0x21):
        raise CodebookError(where, "header", header[-_COUNT.size :], "A0, the number of samples, 21 at its end")
    first = offset + _HEADER_BYTES
    if not 1 <= count <= min(_MAX_SAMPLES, len(data) - first):
        raise CodebookError(where, "samples", count, f"1..{_MAX_SAMPLES}, no more than the file holds")
    return np.frombuffer(data, np.uint8, count, first)


def _channel(folder: Path, channel: str) -> npt.NDArray[np.generic]:
    recordings = sorted(folder.rglob(f"{channel}.SON"))
    if len(recordings) == 1:
        return read_channel(recordings[0])
    images = sorted(folder.glob(f"*{channel}*.png"))
    if recordings or len(images) != 1:
        met = [path.name for path in (*recordings, *images)]
        raise CodebookError(str(folder), channel, met, f"one {channel}.SON, or one PNG with {channel} in its name")
    return read_image(images[0])


def _without_padding(image: npt.NDArray[np.generic]) -> SonarLine:
    """Return the line with the zeros after the end of each ping as NaN."""
    line = image.astype(np.float32)
    line[np.cumsum(line[:, ::-1] != 0, axis=1)[:, ::-1] == 0] = np.nan
    return line


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise CodebookError(str(path), "", error.strerror or str(error), "a file of the recording") from error
