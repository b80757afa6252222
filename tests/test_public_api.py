"""The public names of the package: complete, few, imported on first use."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.survey_lines import line
from builders.surveys import jsf_message
from pyproj import Transformer

import sonarpost
from sonarpost.sonar.survey import Side

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


def line_in_metres(path):
    """Write a recording with one object, whose positions are centimetres of EPSG:32619."""
    to_metres = Transformer.from_crs("EPSG:4326", "EPSG:32619", always_xy=True)
    with path.open("wb") as file:
        for ping in line(bright=None):
            easting_m, northing_m = to_metres.transform(ping.lon_deg, ping.lat_deg)
            place = {"unit": 4, "x": round(easting_m * 100), "y": round(northing_m * 100)}
            for number, side in enumerate(Side):
                samples = ping.channel(side).samples.astype(np.uint16)
                if side is Side.PORT and 57 <= ping.number <= 63:
                    samples[400:410], samples[410:450] = 255, 1  # highlight and shadow
                values = {"altitude": 6000, "heading": 3000, "interval_ns": 66_667}
                file.write(jsf_message(ping.number, 20, number, samples, **place, **values))


def test_a_survey_in_metres_is_opened_and_searched_for_contacts_with_its_projection(tmp_path):
    line_in_metres(tmp_path / "line.jsf")
    options = sonarpost.SurveyOptions(projected_crs="EPSG:32619")
    with sonarpost.open_survey(str(tmp_path / "line.jsf"), options) as source:
        contact = sonarpost.detect(source)[0]
        assert source.info.grid is not None
    assert (contact.side, contact.ping_index) == (Side.PORT, 60)
    assert (contact.position.lat_deg, contact.position.lon_deg) == pytest.approx((48.4, -68.8), abs=0.001)
    with sonarpost.open_survey(tmp_path / "line.jsf") as source:
        assert "set the option projected_crs" in source.info.warnings[0]
        assert {ping.lat_deg for ping in source.pings()} == {None}


def test_records_are_packed_and_unpacked():
    message = sonarpost.OutgoingMessage(
        message_id="m1", source="autonomy", priority=3, lifetime_s=60.0, created_utc_s=1.0, data=b"status"
    )
    assert sonarpost.decode_record(sonarpost.OutgoingMessage, sonarpost.encode_record(message), "test") == message
