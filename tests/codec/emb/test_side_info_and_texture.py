"""Side information, region of interest, and the golden streams of emb."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest
from builders.common import GOLDEN_FOLDER
from hypothesis import given
from hypothesis import strategies as st

from research.common.emb_estimate import encode_with_estimate
from research.recognition.grain import GrainCodec
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.codec.emb.coder import Coder
from sonarpost.codec.emb.model import shipped_model
from sonarpost.codec.emb.side_info import (
    INSIDE_WEIGHT,
    UNIT_WEIGHT,
    RegionOfInterest,
    SideInfo,
    code_side_info,
    region_weights,
)
from sonarpost.codec.emb.transform import layout_of
from sonarpost.codec.interface import StreamHeader
from sonarpost.errors import StreamError

GOLDEN = GOLDEN_FOLDER / "emb"
STANDARD, STRUCTURE, DESPECKLED, HALF = (
    GOLDEN / f"streams{name}.json" for name in ("", "_structure", "_despeckled", "_half_despeckled")
)
FILES = pytest.mark.parametrize("file", [STANDARD, STRUCTURE, DESPECKLED, HALF], ids=lambda path: path.stem)
CODEC = EmbCodec()
MODEL = shipped_model()


def speckled(height_px: int = 80, width_px: int = 80, seed: int = 3) -> np.ndarray:
    """Return gravel with a highlight and a shadow, from integer random numbers: the same on every machine."""
    rng = np.random.default_rng(seed)
    image = rng.integers(40, 110, (height_px, width_px)) + rng.integers(0, 60, (height_px, width_px))
    image[height_px // 3 : height_px // 2, width_px // 4 : width_px // 2] += 80
    image[height_px // 3 : height_px // 2, width_px // 2 : width_px * 3 // 4] //= 8
    return np.clip(image, 0, 255).astype(np.uint8)


def pixels_of(region: RegionOfInterest, size: int = 80) -> tuple[slice, slice]:
    edge = size // 16
    return slice(region.top * edge, (region.bottom + 1) * edge), slice(region.left * edge, (region.right + 1) * edge)


@given(
    mean_index=st.integers(0, 63),
    step=st.integers(0, 7),
    corners=st.none() | st.tuples(*[st.integers(0, 15)] * 4),
    texture=st.none() | st.tuples(*[st.integers(0, 15)] * 8),
    extra=st.integers(0, 6),
)
def test_side_information_round_trips_and_truncates(mean_index, step, corners, texture, extra) -> None:
    region = None
    if corners:
        (top, bottom), (left, right) = sorted(corners[:2]), sorted(corners[2:])
        region = RegionOfInterest(top, left, bottom, right)
    side = SideInfo(mean_index, step, region, texture, extra)
    coder = Coder.writer(40)
    code_side_info(coder, MODEL, side)
    body = coder.finish()
    assert len(body) <= 3 + 2 * (region is not None) + 4 * (texture is not None) + 3 + 5
    assert code_side_info(Coder.reader(body), MODEL, SideInfo(0, 0)) == side
    for length in range(len(body)):
        part = code_side_info(Coder.reader(body[:length]), MODEL, SideInfo(0, 0))
        assert part.mean_index in (-1, mean_index)
        assert part == side or part.start_step == -1


def test_region_of_interest_gets_more_bits() -> None:
    image = speckled()
    region = RegionOfInterest(4, 3, 9, 12)
    rows, columns = pixels_of(region)
    errors = []
    for chosen in (None, region):
        decoded = CODEC.decode(encode_with_estimate(CODEC, image, 128, region=chosen).stream).image.astype(float)
        square = (decoded - image) ** 2
        errors.append((square[rows, columns].mean(), square.mean()))
    assert errors[1][0] < 0.97 * errors[0][0]
    assert errors[1][1] < 1.15 * errors[0][1]


def test_region_weights_cover_the_region_and_others_are_rejected() -> None:
    layout = layout_of(80, 80)
    weight = region_weights(layout, RegionOfInterest(4, 4, 7, 7))
    assert set(np.unique(weight[layout.position])) == {UNIT_WEIGHT, INSIDE_WEIGHT}
    finest = weight[layout.position][:40, 40:]
    assert (finest[10:20, 10:20] == INSIDE_WEIGHT).all()
    assert (finest == INSIDE_WEIGHT).sum() == 100
    assert (region_weights(layout, None) == UNIT_WEIGHT).all()
    for corners in ((-1, 0, 3, 3), (0, 16, 3, 16), (5, 0, 4, 3), (0, 5, 3, 4)):
        with pytest.raises(StreamError, match="region of interest"):
            RegionOfInterest(*corners)


def test_extreme_bodies_decode() -> None:
    """No body is rejected; others are in the contract of the codecs."""
    header = CODEC.encode(speckled(32, 48), 40)[:4]
    header = header[: StreamHeader.unpack(header).size]
    noise = np.random.default_rng(0).integers(0, 256, 400, np.uint8).tobytes()
    for body in (bytes(400), b"\xff" * 400, noise):
        for length in (1, 4, 5, 50, 400):
            assert CODEC.decode(header + body[:length]).image.shape == (32, 48)


def golden_cases(model: str = "standard", strength: float = 0.0) -> dict[str, tuple[np.ndarray, int, EmbCodec]]:
    plain, with_texture = EmbCodec(model, strength), GrainCodec(model, strength)
    return {
        "80x80 at 64 B": (speckled(), 64, plain),
        "140x80 at 256 B": (speckled(140, 80), 256, plain),
        "17x33 at 40 B": (speckled(17, 33), 40, plain),
        "201x300 at 200 B": (speckled(201, 300), 200, plain),
        "80x80 with grain at 68 B": (speckled(), 68, with_texture),
    }


def hashes(stream: bytes, codec: EmbCodec) -> dict[str, str]:
    """Return hashes of the images of the stream and of its first half."""
    parts = {"half": stream[: len(stream) // 2], "whole": stream}
    out = {name: hashlib.sha256(codec.decode(part).image.tobytes()).hexdigest() for name, part in parts.items()}
    if isinstance(codec, GrainCodec):
        out["grain"] = hashlib.sha256(codec.speckle_layer(stream).astype("<i2").tobytes()).hexdigest()
    return out


def options_of_file(file: Path) -> tuple[str, float]:
    """Return model and strength of the golden streams of a file."""
    return {STRUCTURE: ("structure", 0.0), DESPECKLED: ("standard", 1.0), HALF: ("structure", 0.5)}.get(
        file, ("standard", 0.0)
    )


@FILES
def test_golden_streams_of_every_model_are_decoded(file: Path) -> None:
    """The pixels are the same on every machine and in every release that has the model."""
    cases = golden_cases(*options_of_file(file))
    found = json.loads(file.read_text())
    assert set(found) == set(cases)
    for name, golden in found.items():
        assert hashes(bytes.fromhex(golden.pop("stream")), cases[name][2]) == golden, name


@FILES
def test_golden_streams_are_reproduced(file: Path) -> None:
    """The bytes are the same on every machine."""
    golden = json.loads(file.read_text())
    for name, (image, budget, codec) in golden_cases(*options_of_file(file)).items():
        assert codec.encode(image, budget).hex() == golden[name]["stream"], name
