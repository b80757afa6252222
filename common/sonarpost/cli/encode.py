"""`sonarpost encode` and `sonarpost decode`: the paper's Table III over one file or a folder."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np

from sonarpost.codec.interface import Codec, StreamHeader
from sonarpost.codec.registry import CodecRegistry, CodecResources, default_registry
from sonarpost.codec.vq.codebook import default_for_tag, open_codebook
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.errors import SonarpostError, StreamError
from sonarpost.files import write_atomically
from sonarpost.sonar.image_files import read_image, write_png, write_tiff

IMAGE_SUFFIXES = (".tiff", ".tif", ".png")
TEXT_SUFFIX = ".txt"
MAX_STREAM_FILE_BYTES = 1 << 18  # header and the longest body, twice for hex, and room for line ends
EXIT_SOME_FAILED = 1


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add both commands."""
    _add_encode(subparsers)
    _add_decode(subparsers)


def _add_encode(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser("encode", help="encode an image or a folder of images")
    parser.add_argument("input", type=Path, metavar="IMAGE_OR_DIR", help="TIFF or PNG, grey, 8 or 16 bits")
    parser.add_argument("--codec", default="vq", help="codec, one of those `--codec help` lists (default: vq)")
    parser.add_argument(
        "--codebook", default="nominal-10", metavar="NAME_OR_FILE", help="nominal-10 (default), nominal-20 or a file"
    )
    parser.add_argument(
        "--packing",
        choices=[packing.value for packing in IndexPacking],
        default=IndexPacking.BITS14.value,
        help="how vq writes an index (default: 14bit)",
    )
    parser.add_argument("--budget", type=int, metavar="BYTES", help="most bytes of a stream, its header included")
    parser.add_argument("--text", action="store_true", help="write hexadecimal text (.txt), as the paper does")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where streams go (default: beside the image)")
    parser.set_defaults(run=run_encode)


def _add_decode(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = subparsers.add_parser("decode", help="decode a stream or a folder of streams to TIFF and PNG")
    parser.add_argument("input", type=Path, metavar="FILE_OR_DIR", help="what `sonarpost encode` wrote")
    parser.add_argument(
        "--codebook", metavar="NAME_OR_FILE", help="default: the shipped codebook the stream was made with"
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="where images go (default: out/ beside the stream)")
    parser.set_defaults(run=run_decode)


def run_encode(args: argparse.Namespace) -> int:
    """Encode; return 0, or 1 if any file of the folder could not be encoded.

    Raises:
        SonarpostError: The codec or the codebook cannot be had, or the one image given is bad.
    """
    registry = default_registry()
    if args.codec == "help":
        for name in registry.names():
            print(f"{name:12} {registry.spec(name).summary}")
        return 0
    tiles = open_codebook(args.codebook).tiles if registry.spec(args.codec).needs_tiles else None
    codec = registry.create(args.codec, CodecResources(tiles, IndexPacking(args.packing)))
    suffix = TEXT_SUFFIX if args.text else f".{codec.name}"

    def encode_one(path: Path) -> str:
        return _encode_file(codec, path, _target_folder(args.out, path.parent) / (path.stem + suffix), args)

    return _over_files(args.input, IMAGE_SUFFIXES, encode_one)


def run_decode(args: argparse.Namespace) -> int:
    """Decode; return 0, or 1 if any file of the folder could not be decoded.

    Raises:
        SonarpostError: The codebook cannot be had, or the one stream given is bad.
    """
    registry = default_registry()
    suffixes = (*(f".{name}" for name in registry.names()), TEXT_SUFFIX)
    if args.codebook is not None:
        open_codebook(args.codebook)  # a wrong codebook is one error, not one for each file of the folder

    def decode_one(path: Path) -> str:
        return _decode_file(registry, path, _target_folder(args.out, path.parent / "out"), args.codebook)

    return _over_files(args.input, suffixes, decode_one)


def _over_files(source: Path, suffixes: tuple[str, ...], work: Callable[[Path], str]) -> int:
    """Do `work` on one file or on a folder's files; in a folder a bad file is reported and the rest go on."""
    if not source.is_dir():
        print(work(source))
        return 0
    paths = sorted(path for path in source.iterdir() if path.suffix.lower() in suffixes and path.is_file())
    if not paths:
        raise StreamError(str(source), "", "nothing to do", "a folder with files ending in " + ", ".join(suffixes))
    failed = 0
    taken: dict[str, Path] = {}
    for path in paths:
        try:
            if path.stem in taken:
                # Results bear the input's stem, as in the paper: a second one would overwrite the first.
                raise StreamError(str(path), "name", path.stem, f"another stem than that of {taken[path.stem].name}")
            taken[path.stem] = path
            print(work(path))
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
        raise StreamError(str(target), "", error.strerror or str(error), "a file that can be written") from error
    return f"{path} -> {target}: {image.nbytes} B -> {len(stream)} B ({image.nbytes / len(stream):.1f}:1)"


def _decode_file(registry: CodecRegistry, path: Path, folder: Path, codebook: str | None) -> str:
    stream = _read_stream(path)
    header = StreamHeader.unpack(stream, str(path))
    tiles = None
    if registry.spec_for_id(header.codec_id).needs_tiles:
        tiles = (open_codebook(codebook) if codebook is not None else default_for_tag(header.model_tag)).tiles
    decoded = registry.create_for_stream(stream, CodecResources(tiles)).decode(stream)
    target = folder / f"{path.stem}.tiff"
    write_tiff(target, decoded.image)
    write_png(target.with_suffix(".png"), decoded.image)
    lost = ""
    if decoded.missing.any():
        mask = folder / f"{path.stem}.missing.png"
        write_png(mask, decoded.missing.astype(np.uint8) * np.uint8(255))
        lost = f", {100 * decoded.missing.mean():.1f} % missing (white in {mask.name}): {'; '.join(decoded.notes)}"
    return f"{path} -> {target}: {header.height_px} x {header.width_px} px{lost}"


def _read_stream(path: Path) -> bytes:
    """Read a stream, from hexadecimal text if the suffix is .txt."""
    try:
        size = path.stat().st_size
        if size > MAX_STREAM_FILE_BYTES:
            raise StreamError(str(path), "size", f"{size} B", f"at most {MAX_STREAM_FILE_BYTES} B")
        data = path.read_bytes()
    except OSError as error:
        raise StreamError(str(path), "", error.strerror or str(error), "a stream file that can be read") from error
    if path.suffix.lower() != TEXT_SUFFIX:
        return data
    try:
        return bytes.fromhex(data.decode("ascii"))
    except ValueError as error:  # UnicodeDecodeError is one too
        raise StreamError(str(path), "text", data[:40], "hexadecimal digits") from error


def _target_folder(wanted: Path | None, default: Path) -> Path:
    folder = wanted if wanted is not None else default
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StreamError(str(folder), "", error.strerror or str(error), "a folder that can be made") from error
    return folder
