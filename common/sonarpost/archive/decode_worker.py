"""Decoding of images in a process of its own: a stream that crashes the decoder, or never ends, costs that image only.

`DecodeWorker` starts `python -m sonarpost.archive.decode_worker`, writes the part of an image as c2 has accepted it to
its standard input, and reads the decoded image from its standard output. Messages have a length of four bytes before
them. The first one is empty: the process is ready. It ends when its standard input is closed, also if its parent is
killed.
"""

from __future__ import annotations

import logging
import os
import signal
import struct
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final, Literal, NamedTuple

import msgpack

from sonarpost import wire
from sonarpost.archive import image_parts
from sonarpost.archive.decoder import Decoder
from sonarpost.codec.jit import use_code_folder
from sonarpost.codec.vq import codebook
from sonarpost.errors import BadInputError, MissingCodebookError
from sonarpost.limits import limit
from sonarpost.logs import kv
from sonarpost.messages import CodedImage, ImagePart, ReconstructedImage

log = logging.getLogger(__name__)

MAX_DECODE_S: Final = limit(
    120.0, "s of processor time", "deadlines", "decoding of images", "vessel", "one image", "tried again later"
)
"""With the compilation of the codec at the first image. Not real time: other programs are not the fault of an image."""
NICE: Final = 5
"""Lower priority after the first image, so that records are accepted first."""
END_S: Final = 2.0
EXIT_MACHINE: Final = 75
"""Exit status after an error of the machine, for example a lack of memory."""
_MACHINE: Final = frozenset({EXIT_MACHINE, -signal.SIGKILL, -signal.SIGTERM, -signal.SIGINT, -signal.SIGHUP})
_LENGTH = struct.Struct(">I")


class PackedImage(NamedTuple):
    """A decoded image and its payload, which is empty if it is not known."""

    record: ReconstructedImage
    payload: bytes = b""


@dataclass(frozen=True, slots=True)
class Decoded:
    """Result for one image.

    Attributes:
        image: The decoded image; None if it could not be decoded.
        reason: Why not.
        missing_model: The codebook that is not known, as in `coded_image`; empty if that is not the reason.
        failure: `machine` if the process did not start or was killed from outside; `crash` if it ended otherwise or
            exceeded its processor time; else empty.
    """

    image: PackedImage | None = None
    reason: str = ""
    missing_model: str = ""
    failure: Literal["", "machine", "crash"] = ""


class DecodeWorker:
    """A decoding process, started for the first image and again after a crash. Used by one thread at a time.

    Args:
        codebooks: Names or files of codebooks.
        folder: Folder with further codebooks, `{vessel}/{model}.tiles`, which may be added at any time. An image uses
            those of its vessel only.
        state_dir: Folder for the compiled machine code.
        max_decode_s: Maximum processor time for one image.
    """

    def __init__(
        self, codebooks: Sequence[str], folder: Path, state_dir: Path, max_decode_s: float = MAX_DECODE_S
    ) -> None:
        self._command = [
            sys.executable,
            "-m",
            "sonarpost.archive.decode_worker",
            str(folder.absolute()),
            str(state_dir.absolute()),
            str(max_decode_s),
            *codebooks,
        ]
        self._max_decode_s = max_decode_s
        self._process: subprocess.Popen[bytes] | None = None
        self._lock = threading.Lock()
        self._closed = False

    @property
    def pid(self) -> int | None:
        """Identifier of the process; None while it does not run."""
        process = self._process
        return None if process is None else process.pid

    def decode(self, vessel_id: str, payload: bytes) -> Decoded:
        """Decode an accepted image of a vessel."""
        is_new = False
        with self._lock:
            if self._closed:
                return Decoded(reason="the service stops", failure="machine")
            if self._process is None:
                try:
                    self._process = subprocess.Popen(  # noqa: S603  the arguments are those of this module
                        self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE
                    )
                except OSError as error:
                    return Decoded(reason=f"the decoder does not start: {error}", failure="machine")
                is_new = True
            process = self._process
        assert process.stdin is not None
        assert process.stdout is not None
        answer: bytes | None = None
        is_ready = not is_new
        try:
            is_ready = is_ready or _read(process.stdout) is not None
            if is_ready:
                _write(process.stdin, msgpack.packb((vessel_id, payload)))
                answer = _read(process.stdout)
        except (OSError, ValueError):
            answer = None  # the process has ended, or `close` has closed its pipes
        if answer is None:
            with suppress(subprocess.TimeoutExpired):
                process.wait(END_S)  # its own status, not that of the kill
            self._end(process)
            return self._ended(process.returncode, is_ready=is_ready)
        fields = msgpack.unpackb(answer)
        if "payload" not in fields:
            return Decoded(reason=fields["reason"], missing_model=fields["model"])
        payload = fields["payload"]
        return Decoded(PackedImage(wire.decode(ReconstructedImage, payload, f"image of {vessel_id}"), payload))

    def _ended(self, status: int, *, is_ready: bool) -> Decoded:
        if not is_ready:
            return Decoded(reason=f"the decoder does not start: it ended with status {status}", failure="machine")
        if status == -signal.SIGPROF:
            reason = f"the decoder did not finish within {self._max_decode_s:g} s of processor time"
            return Decoded(reason=reason, failure="crash")
        reason = f"the decoder ended with status {status}"
        return Decoded(reason=reason, failure="machine" if status in _MACHINE else "crash")

    def close(self) -> None:
        """End the process, also while it decodes."""
        with self._lock:
            self._closed = True
            process = self._process
        if process is not None:
            self._end(process)

    def _end(self, process: subprocess.Popen[bytes]) -> None:
        with self._lock:
            if self._process is process:
                self._process = None
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with suppress(OSError):  # what was not written yet
                    pipe.close()


def _write(file: IO[bytes], data: bytes) -> None:
    file.write(_LENGTH.pack(len(data)) + data)
    file.flush()


def _read(file: IO[bytes]) -> bytes | None:
    head = file.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    length = _LENGTH.unpack(head)[0]
    data = file.read(length)
    return data if len(data) == length else None


def coded_image(vessel_id: str, payload: bytes) -> CodedImage:
    """Return the coded image of an accepted part.

    Raises:
        PayloadError: It is invalid.
    """
    where = f"image of {vessel_id}"
    return image_parts.coded_image(wire.decode(ImagePart, payload, where), vessel_id, where)


def _decode(decoder: Decoder, folder: Path, payload: bytes) -> dict[str, object]:
    """Return the answer for one image; a codebook that is missing is looked for in the folder."""
    try:
        image = coded_image(*msgpack.unpackb(payload))
        path = folder / image.vessel_id / f"{image.model}{codebook.SUFFIX}"
        further = None
        if image.model and decoder.codebook(image.model) is None and path.is_file():
            try:
                further = codebook.load(path)
            except BadInputError as error:
                # The fault of the file, not of the image: it is fetched again.
                log.warning("Stored codebook cannot be read", extra=kv(file=path, reason=str(error)))
        return {"payload": wire.encode(decoder.decode(image, further))}
    except MissingCodebookError as error:
        return {"reason": str(error), "model": error.model}
    except BadInputError as error:
        return {"reason": str(error), "model": ""}
    except (OSError, MemoryError) as error:
        log.exception("Decoder ends after an error of the machine")
        raise SystemExit(EXIT_MACHINE) from error
    except Exception as error:
        # An unexpected exception costs this image only.
        log.exception("Image not decoded after an unexpected exception")
        return {"reason": f"{type(error).__name__}: {error}", "model": ""}


def main() -> None:
    """Answer images until standard input ends."""
    folder, state_dir, max_decode_s, *codebooks = sys.argv[1:]
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of libraries must not get between the answers
    signal.signal(signal.SIGPROF, signal.SIG_DFL)  # a parent can have ignored it
    use_code_folder(Path(state_dir))
    decoder = Decoder(codebooks)
    _write(answers, b"")
    is_first = True
    while (payload := _read(sys.stdin.buffer)) is not None:
        signal.setitimer(signal.ITIMER_PROF, float(max_decode_s))  # SIGPROF ends the process
        packed: bytes = msgpack.packb(_decode(decoder, Path(folder), payload))
        signal.setitimer(signal.ITIMER_PROF, 0)
        _write(answers, packed)
        if is_first:
            os.nice(NICE)
            is_first = False


if __name__ == "__main__":
    main()
