"""`sonarpost encode` and `sonarpost decode`: the paper's Table III for a file or a folder."""

import argparse
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import add_fit_option, flag, in_new_folder, option, printable
from sonarpost.codec import Codec, StreamHeader, codec_names, decode_image, get_codec
from sonarpost.codec.api import CodecOptions
from sonarpost.codec.fitting import fit_image
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.codec.vq.tiles import TileDatabase
from sonarpost.errors import SonarpostError, StreamError
from sonarpost.files import write_atomically
from sonarpost.sonar.image_decoding import read_any_image
from sonarpost.sonar.image_files import list_images, unused_lines, write_png, write_tiff

STREAM_FOLDER = "streams"
DECODED_FOLDER = "out"
TEXT_SUFFIX = ".txt"
MAX_STREAM_FILE_BYTES = 1 << 18  # header and the longest body, twice for hexadecimal text, and line ends
EXIT_SOME_FAILED = 1


def add_encode(parser: CommandParser) -> None:
    """Add the options of `encode`."""
    option(parser, "input IMAGE_OR_DIR", "JPEG, PNG or TIFF of any depth and colour", Path)
    option(parser, "--codec", "name of a codec; `--codec help` lists them", default="emb")
    option(parser, "--model", "model of emb: standard (default) or structure")
    option(
        parser,
        "--codebook NAME_OR_FILE",
        "codebook of vq: nominal-10 (default), nominal-20 or a file",
        default="nominal-10",
    )
    option(
        parser,
        "--packing",
        "index format of vq (default: 14bit)",
        default=IndexPacking.BITS14.value,
        choices=[packing.value for packing in IndexPacking],
    )
    option(parser, "--budget BYTES", "maximum length of a stream, header included (default: the codec's)", int)
    flag(parser, "--text", "write hexadecimal text (.txt), as the paper does")
    add_fit_option(parser)
    option(parser, "--out DIR", f"folder for the streams (default: {STREAM_FOLDER}/ beside the image)", Path)
    parser.set_defaults(run=run_encode)


def add_decode(parser: CommandParser) -> None:
    """Add the options of `decode`."""
    option(parser, "input FILE_OR_DIR", "a stream, or a folder of streams or of encoded images", Path)
    option(
        parser,
        "--codebook NAME_OR_FILE",
        "codebook of the streams (default: found by the tag in the stream, among the shipped codebooks and the "
        "files and folders in the environment variable SONARPOST_CODEBOOKS)",
    )
    option(parser, "--out DIR", f"folder for the images (default: {DECODED_FOLDER}/ in that folder)", Path)
    parser.set_defaults(run=run_decode)


def run_encode(args: argparse.Namespace) -> int:
    """Encode; return 0, or 1 if any file of the folder could not be encoded."""
    registry = default_registry()
    options: CodecOptions = {} if args.model is None else {"model": args.model}
    if registry.spec(args.codec).needs_tiles:
        options |= {"codebook": args.codebook, "packing": args.packing}
    codec = get_codec(args.codec, **options)
    suffix = TEXT_SUFFIX if args.text else f".{codec.name}"
    folder = args.out if args.out is not None else _folder_of(args.input) / STREAM_FOLDER

    def encode_one(path: Path) -> str:
        return _encode_file(codec, path, folder / (path.stem + suffix), args)

    if not args.input.is_dir():
        print(encode_one(args.input))
        return 0
    found = list_images(args.input, ignore=(folder, args.input / DECODED_FOLDER))
    for line in found.unused:
        print(line, file=sys.stderr)
    if found.side_cars:
        print(
            f"{args.input}: not used: {len(found.side_cars)} *.txt beside images: streams hold no position",
            file=sys.stderr,
        )
    status = _process_files("encoding", found.images, encode_one)
    print(f"decode them with: sonarpost decode {shlex.quote(str(args.input if args.out is None else folder))}")
    return status


def run_decode(args: argparse.Namespace) -> int:
    """Decode; return 0, or 1 if any file of the folder could not be decoded."""
    suffixes = (*(f".{name}" for name in codec_names()), TEXT_SUFFIX)
    # Opened before the loop: an unreadable codebook is one error, not one for each file.
    tiles = open_codebook(args.codebook).tiles if args.codebook is not None else None

    folder = args.out if args.out is not None else _folder_of(args.input) / DECODED_FOLDER

    def decode_one(path: Path) -> str:
        return _decode_file(path, folder, tiles)

    if not args.input.is_dir():
        print(decode_one(args.input))
        return 0
    source = args.input / STREAM_FOLDER
    source = source if source.is_dir() else args.input
    return _process_files("decoding", _list_streams(source, suffixes, folder), decode_one)


def _folder_of(source: Path) -> Path:
    return source if source.is_dir() else source.parent


def _list_streams(folder: Path, suffixes: tuple[str, ...], out: Path) -> list[Path]:
    """Return the streams of a folder; print what else is in it."""
    entries = sorted(path for path in folder.iterdir() if path != out)
    streams = [path for path in entries if path.suffix.lower() in suffixes and path.is_file()]
    if not streams:
        raise StreamError(str(folder), "", "no such file", "a folder with files ending in " + ", ".join(suffixes))
    for line in unused_lines(folder, [(path, "not a stream") for path in entries if path not in streams]):
        print(line, file=sys.stderr)
    return streams


def _process_files(step: str, paths: Sequence[Path], process: Callable[[Path], str]) -> int:
    """Process the files of a folder. An invalid file is reported and the loop continues."""
    failed = 0
    path_by_stem: dict[str, Path] = {}
    with ProgressDisplay() as display:
        for number, path in enumerate(paths):
            display.show(step, number, len(paths), printable(path.name))
            try:
                if path.stem in path_by_stem:
                    # The output has the stem of the input, as in the paper: a second file would overwrite the first.
                    other = path_by_stem[path.stem].name
                    raise StreamError(str(path), "name", path.stem, f"another stem than that of {other}")
                path_by_stem[path.stem] = path
                print(process(path), flush=True)
            except SonarpostError as error:
                failed += 1
                where = "" if str(path) in str(error) else f"{path}: "
                print(f"{where}{error}", file=sys.stderr)
    print(f"{len(paths) - failed} of {len(paths)} files done")
    return EXIT_SOME_FAILED if failed else 0


def _encode_file(codec: Codec, path: Path, target: Path, args: argparse.Namespace) -> str:
    read = read_any_image(path)
    fitted = fit_image(read.pixels, args.fit, str(path))
    image = fitted.pixels
    stream = codec.encode(image, args.budget)
    try:
        write_atomically(in_new_folder(target), (stream.hex() + "\n").encode() if args.text else stream)
    except OSError as error:
        raise StreamError(str(target), "", error.strerror or str(error), "a writable file") from error
    size = f"{image.shape[1]} × {image.shape[0]} px"
    done = f"{path} -> {target}: {size}, {image.nbytes} B -> {len(stream)} B ({image.nbytes / len(stream):.1f}:1)"
    return "; ".join((done, *read.notes, *fitted.notes))


def _decode_file(path: Path, folder: Path, tiles: TileDatabase | None) -> str:
    stream = _read_stream(path)
    header = StreamHeader.unpack(stream, str(path))
    if tiles is None:
        decoded = decode_image(stream)
    else:
        decoded = default_registry().create_for_stream(stream, CodecResources(tiles)).decode(stream)
    target = in_new_folder(folder / f"{path.stem}.tiff")
    write_tiff(target, decoded.image)
    write_png(target.with_suffix(".png"), decoded.image)
    missing = ""
    if decoded.missing.any():
        mask = folder / f"{path.stem}.missing.png"
        write_png(mask, decoded.missing.astype(np.uint8) * np.uint8(255))
        missing = f", {100 * decoded.missing.mean():.1f} % missing (white in {mask.name}): {'; '.join(decoded.notes)}"
    return f"{path} -> {target}: {header.width_px} × {header.height_px} px{missing}"


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
