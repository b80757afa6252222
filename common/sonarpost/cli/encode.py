"""`sonarpost encode` and `sonarpost decode`: the paper's Table III for a file or a folder."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sonarpost.cli.shared import Subparsers
from sonarpost.codec import Codec, StreamHeader, codec_names, decode_image, get_codec
from sonarpost.codec.api import CodecOptions
from sonarpost.codec.registry import RETIRED_NAMES, CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import SonarpostError, StreamError
from sonarpost.files import write_atomically
from sonarpost.sonar.image_files import read_image, write_png, write_tiff

IMAGE_SUFFIXES = (".tiff", ".tif", ".png")
TEXT_SUFFIX = ".txt"
MAX_STREAM_FILE_BYTES = 1 << 18  # header and the longest body, twice for hexadecimal text, and line ends
EXIT_SOME_FAILED = 1


def add_parser(subparsers: Subparsers) -> None:
    """Add both commands."""
    encode = subparsers.add_parser("encode", help="encode an image or a folder of images")
    encode.add_argument("input", type=Path, metavar="IMAGE_OR_DIR", help="TIFF or PNG, grey, 8 or 16 bits")
    encode.add_argument(
        "--codec", default="emb", help="name of a codec; `--codec help` lists them (default: %(default)s)"
    )
    encode.add_argument("--model", help="model of emb: standard (default) or structure")
    encode.add_argument(
        "--codebook",
        default="nominal-10",
        metavar="NAME_OR_FILE",
        help="codebook of vq: nominal-10 (default), nominal-20 or a file",
    )
    encode.add_argument(
        "--packing",
        choices=[packing.value for packing in IndexPacking],
        default=IndexPacking.BITS14.value,
        help="index format of vq (default: 14bit)",
    )
    encode.add_argument(
        "--budget", type=int, metavar="BYTES", help="maximum length of a stream, header included (default: the codec's)"
    )
    encode.add_argument("--text", action="store_true", help="write hexadecimal text (.txt), as the paper does")
    encode.add_argument("--out", type=Path, metavar="DIR", help="folder for the streams (default: that of the image)")
    encode.set_defaults(run=run_encode)
    decode = subparsers.add_parser("decode", help="decode a stream or a folder of streams to TIFF and PNG")
    decode.add_argument("input", type=Path, metavar="FILE_OR_DIR", help="output of `sonarpost encode`")
    decode.add_argument(
        "--codebook",
        metavar="NAME_OR_FILE",
        help="codebook of the streams (default: found by the tag in the stream, among the shipped codebooks and the "
        "files and folders in the environment variable SONARPOST_CODEBOOKS)",
    )
    decode.add_argument(
        "--out", type=Path, metavar="DIR", help="folder for the images (default: out/ beside the stream)"
    )
    decode.set_defaults(run=run_decode)


def run_encode(args: argparse.Namespace) -> int:
    """Encode; return 0, or 1 if any file of the folder could not be encoded."""
    registry = default_registry()
    if args.codec == "help":
        for name in registry.names():
            print(f"{name:16} {registry.spec(name).summary}")
        return 0
    options: CodecOptions = {} if args.model is None else {"model": args.model}
    if registry.spec(args.codec).needs_tiles:
        options |= {"codebook": args.codebook, "packing": args.packing}
    codec = get_codec(args.codec, **options)
    suffix = TEXT_SUFFIX if args.text else f".{codec.name}"

    def encode_one(path: Path) -> str:
        return _encode_file(codec, path, _output_folder(args.out, path.parent) / (path.stem + suffix), args)

    return _process_files(args.input, IMAGE_SUFFIXES, encode_one)


def run_decode(args: argparse.Namespace) -> int:
    """Decode; return 0, or 1 if any file of the folder could not be decoded."""
    suffixes = (*(f".{name}" for name in (*codec_names(), *RETIRED_NAMES)), TEXT_SUFFIX)
    # Opened before the loop: an unreadable codebook is one error, not one for each file.
    tiles = open_codebook(args.codebook).tiles if args.codebook is not None else None

    def decode_one(path: Path) -> str:
        return _decode_file(path, _output_folder(args.out, path.parent / "out"), tiles)

    return _process_files(args.input, suffixes, decode_one)


def _process_files(source: Path, suffixes: tuple[str, ...], process: Callable[[Path], str]) -> int:
    """Process one file, or the files of a folder. In a folder, an invalid file is reported and the loop continues."""
    if not source.is_dir():
        print(process(source))
        return 0
    paths = sorted(path for path in source.iterdir() if path.suffix.lower() in suffixes and path.is_file())
    if not paths:
        raise StreamError(str(source), "", "no such file", "a folder with files ending in " + ", ".join(suffixes))
    failed = 0
    path_by_stem: dict[str, Path] = {}
    for path in paths:
        try:
            if path.stem in path_by_stem:
                # The output has the stem of the input, as in the paper: a second file would overwrite the first.
                other = path_by_stem[path.stem].name
                raise StreamError(str(path), "name", path.stem, f"another stem than that of {other}")
            path_by_stem[path.stem] = path
            print(process(path))
        except SonarpostError as error:
            failed += 1
            print(f"{path.name}: {error}", file=sys.stderr)
    print(f"{len(paths) - failed} of {len(paths)} files done")
    return EXIT_SOME_FAILED if failed else 0


def _encode_file(codec: Codec, path: Path, target: Path, args: argparse.Namespace) -> str:
    image = read_image(path)
    stream = codec.encode(image, args.budget)
    try:
        write_atomically(target, (stream.hex() + "\n").encode() if args.text else stream)
    except OSError as error:
        raise StreamError(str(target), "", error.strerror or str(error), "a writable file") from error
    return f"{path} -> {target}: {image.nbytes} B -> {len(stream)} B ({image.nbytes / len(stream):.1f}:1)"


def _decode_file(path: Path, folder: Path, tiles: TileDatabase | None) -> str:
    stream = _read_stream(path)
    header = StreamHeader.unpack(stream, str(path))
    if tiles is None:
        decoded = decode_image(stream)
    else:
        decoded = default_registry().create_for_stream(stream, CodecResources(tiles)).decode(stream)
    target = folder / f"{path.stem}.tiff"
    write_tiff(target, decoded.image)
    write_png(target.with_suffix(".png"), decoded.image)
    missing = ""
    if decoded.missing.any():
        mask = folder / f"{path.stem}.missing.png"
        write_png(mask, decoded.missing.astype(np.uint8) * np.uint8(255))
        missing = f", {100 * decoded.missing.mean():.1f} % missing (white in {mask.name}): {'; '.join(decoded.notes)}"
    return f"{path} -> {target}: {header.width_px} x {header.height_px} px{missing}"


def _read_stream(path: Path) -> bytes:
    """Read a stream, from hexadecimal text if the suffix is .txt."""
    try:
        size = path.stat().st_size
        if size > MAX_STREAM_FILE_BYTES:
            raise StreamError(str(path), "size", f"{size} B", f"at most {MAX_STREAM_FILE_BYTES} B")
        data = path.read_bytes()
    except OSError as error:
        raise StreamError(str(path), "", error.strerror or str(error), "a readable stream file") from error
    if path.suffix.lower() != TEXT_SUFFIX:
        return data
    try:
        return bytes.fromhex(data.decode("ascii"))
    except ValueError as error:  # includes UnicodeDecodeError
        raise StreamError(str(path), "text", data[:40], "hexadecimal digits") from error


def _output_folder(chosen: Path | None, default: Path) -> Path:
    folder = chosen if chosen is not None else default
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StreamError(str(folder), "", error.strerror or str(error), "a folder that can be created") from error
    return folder
