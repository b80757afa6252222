"""Georeferenced images of contacts: position of the object."""

import math
from dataclasses import replace

import pytest
import tifffile
from builders.survey_lines import brightest_px, pixel
from builders.xtf import write_xtf

from sonarpost.cli.main import main
from sonarpost.detection import candidates
from sonarpost.detection.detector import detect
from sonarpost.extensions.maps.contact_map import contact_map
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey


@pytest.fixture(scope="module", autouse=True)
def few_candidates():
    """Classify fewer places of a side: the same objects are found in a third of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(candidates, "_MAX_PER_1000_PINGS", 20)
        yield


@pytest.fixture(scope="module")
def simulated():
    return simulate_survey(SurveySpec(seed=1, pings=400, targets=4, clutter=0))


@pytest.fixture(scope="module")
def found(simulated):
    return detect(simulated.survey)


def nearest(found, item):
    """Return the detection of an object, and its distance in pings."""
    on_side = [d for d in found if d.side is item.side and abs(d.sample - item.sample_index) < 60]
    return min(on_side, key=lambda d: abs(d.ping_index - item.ping))


def test_object_is_within_1_m_of_its_position(tmp_path, simulated, found):
    """The middle of the brightest pixels around the true position."""
    for item in simulated.truth:
        seabed = contact_map(simulated.survey, nearest(found, item), 20, 0.1)
        seabed.write(tmp_path / "a.tif")
        column, row = pixel(tmp_path / "a.tif", item)
        assert math.dist((column, row), (100, 100)) * 0.1 < 1.0  # the contact is in the centre
        image = tifffile.imread(tmp_path / "a.tif")
        assert image.shape == (200, 200)
        assert math.dist(brightest_px(image, column, row), (column, row)) * 0.1 < 1.0


def test_unknown_place_gives_no_image(simulated, found):
    for name in ("position", "altitude_m", "pixel_along_m"):
        assert contact_map(simulated.survey, replace(found[0], **{name: None}), 20, 0.1) is None


def test_image_at_the_end_of_the_recording_has_no_data_beyond(simulated, found):
    detection = found[0]
    rows = slice(0, detection.ping_index + 5)
    seabed = contact_map(replace(simulated.survey, pings=simulated.survey.pings[rows]), detection, 20, 0.1)
    assert seabed.image.shape == (200, 200)
    assert seabed.image[98:102, 98:102].all()
    assert 0.2 < (seabed.image > 0).mean() < 0.7


def test_command_writes_images_beside_the_snippets(tmp_path, simulated, capsys):
    path = tmp_path / "line.xtf"
    write_xtf(simulated.survey, path)
    assert main(["detect", str(path), "--snippets", str(tmp_path / "s"), "--geotiff", "--max-contacts", "1"]) == 0
    assert sorted(p.name for p in (tmp_path / "s").glob("*.tif")) == ["line-001.tif"]
    assert tifffile.imread(tmp_path / "s" / "line-001.tif").shape == (200, 200)
    capsys.readouterr()
    assert main(["detect", str(path), "--geotiff"]) == 2
    assert "--geotiff together with --snippets" in capsys.readouterr().err
    assert main(["detect", "--images", str(tmp_path), "--geotiff"]) == 2
    assert "with survey files only" in capsys.readouterr().err
