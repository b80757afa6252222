"""Error of lengths on images of the codec emb, against the stated standard deviation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from research.edge_blur import HEIGHT_PX, WIDTH_PX, known_objects, length_errors, main, measured_edges
from sonarpost.codec import emb
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.review.edge_blur import EMB_TABLE, edge_sigma_px
from sonarpost.review.measurement import CLICK_SIGMA_PX

PIXELS = HEIGHT_PX * WIDTH_PX
CODEC = EmbCodec(strength=emb.DEFAULT_STRENGTH)


@pytest.fixture(scope="module")
def streams():
    """Objects of another seed than those of the table, with their streams."""
    return [(known, CODEC.encode(known.image, 64)) for known in known_objects(60, seed=7)]


@pytest.mark.parametrize("size", [24, 64])
def test_stated_sigma_covers_the_error_of_a_length_in_68_percent(streams, size):
    rng = np.random.default_rng(size)
    errors = []
    for known, stream in streams:
        image = CODEC.decode(stream[:size]).image
        clicks = rng.normal(0, CLICK_SIGMA_PX, 4)
        for error, click in zip(length_errors(known, image), (clicks[:2], clicks[2:]), strict=True):
            errors.append(error + click[0] - click[1])
    sigma_px = math.sqrt(2) * math.hypot(CLICK_SIGMA_PX, edge_sigma_px("emb", size, PIXELS))
    covered = float(np.mean(np.abs(errors) <= sigma_px))
    # 120 errors: 0.68 ± 0.085 (two standard deviations).
    assert 0.59 <= covered <= 0.78


def test_more_bytes_never_increase_the_uncertainty_and_that_of_vq_is_a_tile() -> None:
    for codec in ("emb", "spiht", "vq"):
        sigmas = [edge_sigma_px(codec, size, PIXELS) for size in (0, 8, 24, 48, 64, 96, 131, 192, 314, 629, 5000)]
        assert sigmas == sorted(sigmas, reverse=True)
        assert sigmas[0] > sigmas[-1]
    assert edge_sigma_px("emb", 24, PIXELS) > 2 * edge_sigma_px("emb", 64, PIXELS)
    assert edge_sigma_px("vq", 196, PIXELS) == pytest.approx(10 / math.sqrt(3))
    assert edge_sigma_px("vq", 49, PIXELS) == pytest.approx(20 / math.sqrt(3))


def test_edges_of_a_box_are_found():
    profile = np.full(60, 90.0)
    profile[20:34] = 200.0
    assert measured_edges(profile, 21.2, 32.5) == (20, 34)
    assert measured_edges(-profile, 21.2, 32.5, dark=True) == (20, 34)


def test_command_prints_the_table(capsys):
    assert main(["--objects", "2"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()[1:]]
    assert [float(row[1]) for row in rows] == [density for density, _ in EMB_TABLE]
