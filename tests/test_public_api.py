"""The public names of the package: complete, few, imported on first use."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.xtf import write_xtf

import sonarpost
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.readers import read_survey

HEAVY = ("numba", "numpy", "scipy", "pydantic", "zenoh", "serial", "PIL")


def test_every_public_name_exists_and_is_documented_and_there_are_at_most_40():
    for name in sonarpost.__all__:
        assert getattr(sonarpost, name).__doc__
        assert name in dir(sonarpost)
    assert len(sonarpost.__all__) + 1 <= 40  # and __version__


def test_type_checkers_and_imports_on_first_use_agree():
    tree = ast.parse(Path(sonarpost.__file__).read_text(encoding="utf-8"))
    checked = {
        alias.asname or alias.name: (node.module, alias.name)
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sonarpost.")
        for alias in node.names
    }
    assert checked.keys() == set(sonarpost.__all__)
    for name, (module, original) in checked.items():
        assert getattr(sonarpost, name) is getattr(sys.modules[module or ""], original)


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="'sonarpost' has no attribute 'compress'"):
        _ = sonarpost.compress


def test_import_alone_loads_no_library():
    code = f"import sys, sonarpost; print([name for name in {HEAVY!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_three_lines_encode_and_decode_an_image():
    image = np.random.default_rng(1).gamma(4.0, 25.0, (80, 140)).clip(0, 255).astype(np.uint8)
    stream = sonarpost.encode(image, budget=64)
    decoded = sonarpost.decode(stream)
    assert len(stream) <= 64
    assert decoded.shape == image.shape
    # A codebook is found by the tag of its identity in the stream.
    for codebook in ("nominal-10", "nominal-20"):
        assert sonarpost.decode(sonarpost.encode(image, codec="vq", codebook=codebook)).shape == image.shape


def test_a_survey_in_metres_is_opened_and_searched_for_contacts_with_its_projection(tmp_path):
    survey = simulate_survey(SurveySpec(seed=1, pings=200, samples=512, clutter=0)).survey
    write_xtf(survey, tmp_path / "line.xtf", projected_crs="EPSG:32630")
    options = sonarpost.SurveyOptions(projected_crs="EPSG:32630")
    with sonarpost.open_survey(str(tmp_path / "line.xtf"), options) as source:
        contacts = sonarpost.detect(source)
        assert source.info.grid is not None
    assert contacts
    for contact in contacts:
        assert contact.position is not None
        assert (contact.position.lat_deg, contact.position.lon_deg) == pytest.approx((56.45, -5.6), abs=0.002)
    with sonarpost.open_survey(tmp_path / "line.xtf") as source:
        assert "set the option projected_crs" in source.info.warnings[0]
    assert {ping.lat_deg for ping in read_survey(tmp_path / "line.xtf")} == {None}


def test_records_are_packed_and_unpacked():
    message = sonarpost.OutgoingMessage(
        message_id="m1", source="autonomy", priority=3, lifetime_s=60.0, created_utc_s=1.0, data=b"status"
    )
    assert sonarpost.decode_record(sonarpost.OutgoingMessage, sonarpost.encode_record(message), "test") == message
