"""Training windows cut from side-scan lines."""

import numpy as np
import pytest
from builders.images import speckle_line

from research.common.patches import PatchPlan, ToneMapping, cut_around, cut_line, reduce_line, stretch


def test_tone_table_is_its_curve_and_reduction_averages_blocks() -> None:
    assert ToneMapping(1.0, 1.0).table().tolist() == list(range(256))
    dark = ToneMapping(2.0, 0.5).table()
    assert (dark[0], dark[255], dark[128]) == (0, 128, 32)
    assert ToneMapping(1.0, 3.0).table()[-1] == 255
    values = np.arange(24, dtype=np.float32).reshape(4, 6)
    assert reduce_line(values, 2, 3).tolist() == [[4.0, 7.0], [16.0, 19.0]]
    assert reduce_line(values, 3, 4).shape == (1, 1)


def test_stretch_maps_the_percentiles_to_the_ends() -> None:
    window = np.arange(10_000, dtype=float).reshape(100, 100)
    window[0, 0], window[-1, -1] = -1e6, 1e6  # outliers beyond the percentiles
    stretched = stretch(window)
    assert stretched.min() == 0
    assert stretched.max() == 255
    assert (stretched == 0).sum() == pytest.approx(100, abs=25)
    assert (stretched == 255).sum() == pytest.approx(50, abs=25)
    assert stretched[50, 50] == pytest.approx(255 * (5050 - 99) / (9949 - 99), abs=1)
    assert not stretch(np.full((9, 9), 7.0)).any()


def test_missing_and_flat_windows_are_skipped() -> None:
    values = speckle_line()
    values[:, 160:] = np.nan
    values[:80, :80] = 40.0
    plan = PatchPlan(reductions=((1, 1),), tones=(ToneMapping(1.0, 1.0),))
    places = {image.name.split(" at ")[1].split(" #")[0] for image in cut_line("x", values, plan)}
    assert places == {"0,80", "80,0", "80,80", "160,0", "160,80"}
    assert all(image.load().shape == (80, 80) for image in cut_line("x", values, plan))


def test_windows_are_limited_and_repeated_in_other_tones_and_mirrored() -> None:
    plan = PatchPlan(reductions=((1, 1), (2, 2)), per_reduction=1, copies=3)
    images = list(cut_line("x", speckle_line(), plan))
    assert len(images) == 6
    assert len({image.name for image in images}) == 6
    assert len({image.load().tobytes() for image in images}) == 6
    plan = PatchPlan(reductions=((1, 1),), per_reduction=1, tones=(ToneMapping(1.0, 1.0),), copies=4)
    plain = list(cut_line("x", speckle_line(), plan))
    first = plain[0].load()
    for image, expected in zip(plain, (first, first[::-1], first[:, ::-1], first[::-1, ::-1]), strict=True):
        assert np.array_equal(image.load(), expected)


def test_windows_around_an_object_contain_it() -> None:
    values = speckle_line()
    values[140:150, 120:135] = 2000.0
    plan = PatchPlan(reductions=((1, 1), (2, 1), (9, 9)), copies=3)
    images = list(cut_around("x", values, [(145, 127)], plan))
    assert len(images) == 6  # with a reduction of 9 the line is smaller than a window
    assert all((image.load() > 100).sum() > 40 for image in images)
    corner = list(cut_around("x", values, [(0, 0), (299, 259)], PatchPlan(reductions=((1, 1),))))
    assert [image.load().shape for image in corner] == [(80, 80), (80, 80)]
