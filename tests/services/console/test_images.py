"""Rendering of images, and measurements on them."""

from __future__ import annotations

import io
import math
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from builders.console import contact_id, image_record
from PIL import Image

from sonarpost.detection.snippets import cut_snippet
from sonarpost.messages import Contact
from sonarpost.review import rendering
from sonarpost.review.image_geometry import contact_box, contact_mark, range_axis
from sonarpost.review.measurement import NotMeasurableError, height_from_shadow, measure_length
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.sonar.survey import Side

ID = contact_id()
VERSION = f"/api/contacts/{ID}/versions/1"


@pytest.fixture
def anna(console):
    console.state.store_image(image_record(missing_rows=10))
    return console.browser("anna")


def pixels_of(answer) -> np.ndarray:
    assert answer.status_code == 200, answer.text
    assert answer.headers["content-type"] == "image/png"
    return np.asarray(Image.open(io.BytesIO(answer.content)))


def test_raw_layer_equals_the_received_pixels(anna):
    answer = anna.get(f"{VERSION}/picture.png")
    assert (pixels_of(answer) == image_record(missing_rows=10).picture.to_array()).all()
    assert answer.headers["x-measurable"] == "true"
    assert "immutable" in answer.headers["cache-control"]


def test_enhanced_layer_is_marked_as_not_measurable(anna):
    answer = anna.get(f"{VERSION}/picture.png", layer="enhanced")
    assert answer.headers["x-measurable"] == "false"
    image = pixels_of(answer)
    assert (image[-10:] == 0).all()
    assert (image != image_record(missing_rows=10).picture.to_array()).any()
    layers = anna.contact(ID)["versions"][0]["layers"]
    assert {layer["name"]: layer["measurable"] for layer in layers} == {"raw": True, "enhanced": False}
    assert anna.get(f"{VERSION}/picture.png", layer="grain").status_code == 404


def test_masks_and_thumbnail_show_missing_and_guessed_pixels(anna):
    missing = pixels_of(anna.get(f"{VERSION}/mask.png"))
    assert (missing[:-10] == 0).all()
    assert (missing[-10:] == 255).all()
    assert (pixels_of(anna.get(f"{VERSION}/mask.png", kind="guessed")) == 0).all()
    guessed = pixels_of(anna.get(f"{VERSION}/mask.png", kind="guessed", layer="enhanced"))
    assert (guessed == 255 - missing).all()
    # The thumbnail hatches missing areas.
    small = pixels_of(anna.get(f"{VERSION}/thumbnail.png"))
    assert max(small.shape) <= 96
    assert (small[-9:] > 60).all()


def test_colour_maps_are_monotonic_and_apply_levels():
    ramp = np.arange(256, dtype=np.uint8)[None, :]
    for name in rendering.MAPS:
        colours = rendering.render(ramp, name)
        assert colours.shape == ((1, 256) if name == "grey" else (1, 256, 3))
        steps = np.diff(colours.reshape(256, -1).astype(int).sum(axis=1))
        assert (steps <= 0).all() if name == "inverse" else (steps >= 0).all()
    narrow = rendering.render(ramp, low_percent=20, high_percent=60)[0]
    assert (narrow[:51] == 0).all()
    assert (narrow[154:] == 255).all()
    assert rendering.render(ramp, gamma=0.5)[0, 64] == 128
    # Sixteen bits become the most significant eight.
    assert rendering.eight_bits(np.array([[0, 255, 256, 65535]], np.uint16)).tolist() == [[0, 0, 1, 255]]


def test_error_names_the_invalid_parameter(anna):
    for name, value in (("low", "100"), ("gamma", "0"), ("map", "jet"), ("layer", "best"), ("high", "x")):
        answer = anna.get(f"{VERSION}/picture.png", **{name: value})
        assert (answer.status_code, answer.json()["error"]["field"]) == (400, name)


def measure(anna, **changes):
    body = {"version": 1, "layer": "raw", "kind": "shadow", "from": [10.0, 10.0], "to": [10.0, 50.0], "keep": False}
    return anna.post(f"/api/contacts/{ID}/measure", {**body, **changes})


def test_height_from_shadow_with_uncertainty(anna):
    found = measure(anna).json()
    # 40 columns of 0.05 m; altitude 5 m and ground range 12 m give slant range 13 m.
    assert found["value_m"] == pytest.approx(2.0)
    assert found["height_m"] == pytest.approx(2.0 * 5 / 15)
    assert found["height_inputs"] == {"shadow_m": 2.0, "altitude_m": 5.0, "slant_range_m": 13.0}
    assert found["metres"] == "slant"
    # 40 x 60 px of 200 bytes; clicks, blur and 2.5 % of the pixel size.
    assert found["sigma_m"] == pytest.approx(math.hypot(0.05 * math.sqrt(2) * math.hypot(0.7, 0.58), 0.05), rel=0.01)
    assert 0 < found["height_sigma_m"] < 0.1
    assert found["id"] is None
    assert anna.contact(ID)["measurements"] == []
    # A shadow lies across the track.
    found = measure(anna, to=[14.0, 50.0]).json()
    assert (found["to"], found["along_m"]) == ([10.0, 50.0], 0.0)


def test_stored_measurement_is_in_the_audit(anna):
    found = measure(anna, kind="length", **{"from": [0.0, 10.0], "to": [20.0, 10.0]}, keep=True).json()
    assert (found["value_m"], found["height_m"]) == (pytest.approx(2.0), None)
    detail = anna.contact(ID)
    assert detail["measurements"] == [found]
    [entry] = detail["audit"]
    assert (entry["action"], entry["user"], entry["detail"]["value_m"]) == ("measure", "anna", found["value_m"])


def test_missing_or_synthesised_pixels_and_unknown_sizes_are_not_measurable(anna, make_console):
    for changes, field in (
        ({"layer": "enhanced"}, "layer"),
        ({"kind": "length", "to": [38.0, 50.0]}, "line"),
        ({"to": [10.0, 10.0]}, "to"),
        ({"to": [10.0, 60.5]}, "to"),
        ({"layer": "grain"}, "layer"),
    ):
        answer = measure(anna, **changes)
        assert answer.status_code == 409
        assert (answer.json()["measurable"], answer.json()["error"]["field"]) == (False, field)
    other = make_console()
    other.state.store_image(image_record(pixel_along_m=None))
    answer = measure(other.browser("anna"))
    assert (answer.status_code, answer.json()["measurable"]) == (409, False)


def test_height_needs_altitude_and_range():
    missing = np.zeros((40, 60), np.bool_)
    known = {"contact_id": "c", "vehicle_id": "v", "pixel_along_m": 0.1, "pixel_across_m": 0.05}
    without = Contact(**known)
    shadow = measure_length(without, missing, (0, 0), (0, 40))
    assert height_from_shadow(without, shadow) is None
    assert height_from_shadow(Contact(**known, altitude_m=5.0), shadow) is None
    slant = height_from_shadow(Contact(**known, altitude_m=5.0, slant_range_m=13.0), shadow)
    ground = height_from_shadow(Contact(**known, altitude_m=5.0, ground_range_m=12.0), shadow)
    assert slant == ground


FAR = {"contact_id": "c", "vehicle_id": "v", "pixel_along_m": 0.1, "pixel_across_m": 0.05, "channel": "port"}


def test_length_uncertainty_equals_a_monte_carlo_simulation():
    contact = Contact(**FAR, altitude_m=5.0, ground_range_m=12.0)
    missing = np.zeros((200, 200), np.bool_)
    length = measure_length(contact, missing, (50, 50), (90, 130), 2.0)
    rng = np.random.default_rng(1)
    count = 40_000
    ends = np.array([50, 50, 90, 130]) + rng.normal(0, math.hypot(0.7, 2.0), (count, 4))
    scale = rng.normal(1, 0.025, count)
    altitude_m = rng.normal(5.0, 0.25, count)
    # The contact is between columns 50 and 100, at slant range 13 m.
    offset_m = rng.normal(0, math.hypot(50 * 0.05, 0.1) / math.sqrt(12), count)
    slant_m = (13.0 + offset_m)[:, None] + scale[:, None] * (ends[:, 1::2] - 75.5) * 0.05
    across_m = np.diff(np.sqrt(slant_m**2 - altitude_m[:, None] ** 2), axis=1)[:, 0]
    lengths = np.hypot(scale * (ends[:, 2] - ends[:, 0]) * 0.1, across_m)
    assert length.metres == "ground"
    assert length.value_m == pytest.approx(lengths.mean(), rel=0.02)
    assert length.sigma_m == pytest.approx(lengths.std(), rel=0.1)
    assert math.hypot(length.along_m, length.across_m) == pytest.approx(length.value_m)


def test_across_track_length_is_converted_to_the_ground():
    missing = np.zeros((40, 60), np.bool_)
    # Slant range 5 m at 4 m of altitude: 0.05 m of slant range are about 0.083 m of ground range.
    near = Contact(**FAR, altitude_m=4.0, ground_range_m=3.0)
    column = contact_mark(near, 40, 60).column
    length = measure_length(near, missing, (20, column), (20, column + 20))
    assert length.value_m == pytest.approx(math.sqrt(6.0**2 - 4.0**2) - 3.0)
    along = measure_length(near, missing, (10, 20), (30, 20))
    assert (along.value_m, along.range_sigma_m) == (pytest.approx(2.0), 0.0)


@pytest.mark.parametrize(
    ("changes", "metres", "range_sigma_m"),
    [
        ({}, "slant", 0.2),
        ({"altitude_m": 4.0}, "slant", 0.2),
        # In the water column: at slant range 4.1 m, nearer than 1.05 x (4 + 0.25) m.
        ({"altitude_m": 4.0, "slant_range_m": 4.1}, "slant", 0.2),
        ({"channel": None}, "unknown", 0.2),
    ],
)
def test_length_that_is_not_converted_has_a_larger_uncertainty(changes, metres, range_sigma_m):
    missing = np.zeros((40, 60), np.bool_)
    length = measure_length(Contact(**{**FAR, **changes}), missing, (20, 20), (20, 40))
    assert (length.value_m, length.metres) == (pytest.approx(1.0), metres)
    assert length.range_sigma_m == pytest.approx(range_sigma_m)


def test_range_of_square_pixels_is_unknown():
    missing = np.zeros((40, 60), np.bool_)
    square = Contact(**{**FAR, "pixel_along_m": 0.05}, altitude_m=5.0, ground_range_m=12.0)
    assert (range_axis(square), range_axis(Contact(**FAR)), range_axis(None)) == (None, "slant", None)
    length = measure_length(square, missing, (20, 20), (20, 40))
    ground = measure_length(Contact(**FAR, altitude_m=5.0, ground_range_m=12.0), missing, (20, 20), (20, 40))
    assert length.value_m == pytest.approx(1.0)
    assert length.range_sigma_m == pytest.approx(ground.value_m - 1.0)
    height = height_from_shadow(square, measure_length(square, missing, (20, 20), (20, 40), to_ground=False))
    assert height.sigma_m > 1.0 * 5 / (12 + 1) - 1.0 * 5 / (13 + 1)


def test_mark_and_box_contain_the_contact_of_a_snippet():
    survey = simulate_survey(SurveySpec(seed=1, pings=200, samples=512, targets=1, clutter=0)).survey
    across_m = 30.0 / 512
    for range_m, shadow_samples in product((1.0, 2.0, 6.0, 20.0), (0, 30, 200)):
        sample = round(range_m / across_m)
        detection = SimpleNamespace(ping_index=100, sample=sample, shadow_samples=shadow_samples, side=Side.PORT)
        cut = cut_snippet(survey, detection, 80, 140)
        contact = Contact(**{**FAR, "pixel_across_m": across_m}, slant_range_m=(sample + 0.5) * across_m)
        mark, box = contact_mark(contact, *cut.image.shape), contact_box(contact, *cut.image.shape)
        assert mark.row == 100 - cut.first_ping_index + 0.5
        assert mark.columns[0] - 0.5 <= sample - cut.first_sample + 0.5 <= mark.columns[1] + 0.5
        assert box.columns[0] <= sample - cut.first_sample <= box.columns[1]
        assert box.rows == (pytest.approx(30.5), pytest.approx(50.5))


def test_version_states_mark_box_and_range_axis_where_they_are_known(anna):
    assert contact_mark(None, 40, 60) is None
    assert contact_mark(Contact(**FAR), 40, 60) is None
    assert contact_box(Contact(**{**FAR, "pixel_along_m": None}, slant_range_m=9.0), 40, 60) is None
    [version] = anna.contact(ID)["versions"]
    assert version["range_axis"] == "slant"
    assert version["mark"] == {"row": 20.5, "column": 23.0, "columns": [15.5, 30.5], "range_m": 13.0}
    assert version["box"] == {"rows": [10.5, 30.5], "columns": [0.0, 50.5]}
    assert version["edge_sigma_px"] == pytest.approx(0.58)


def test_withdrawn_measurement_is_stored_and_does_not_count(anna):
    kept = [measure(anna, **{"from": [10.0, 10.0], "to": [10.0, end]}, keep=True).json() for end in (30.0, 50.0)]
    size = anna.contact(ID)["size"]
    assert size["shadow"] == {"value_m": 2.0, "sigma_m": kept[1]["sigma_m"], "measurement": kept[1]["id"]}
    assert size["height"]["value_m"] == kept[1]["height_m"]
    assert (size["length"], size["width"]) == (None, None)
    path = f"/api/contacts/{ID}/measure/{kept[1]['id']}/withdraw"
    withdrawn = anna.post(path, {}).json()
    assert (withdrawn["id"], withdrawn["withdrawn_by"]) == (kept[1]["id"], "anna")
    detail = anna.contact(ID)
    assert [one["withdrawn_by"] for one in detail["measurements"]] == [None, "anna"]
    assert detail["size"]["shadow"]["measurement"] == kept[0]["id"]
    entry = detail["audit"][-1]
    assert (entry["action"], entry["user"], entry["detail"]["id"]) == ("withdraw", "anna", kept[1]["id"])
    assert anna.post(path, {}).status_code == 404
    assert anna.post(f"/api/contacts/{ID}/measure/{2**70}/withdraw", {}).status_code == 404


def test_line_over_one_missing_pixel_is_rejected():
    contact = Contact(contact_id="c", vehicle_id="v", pixel_along_m=0.1, pixel_across_m=0.05)
    missing = np.zeros((40, 60), np.bool_)
    missing[20, 30] = True
    with pytest.raises(NotMeasurableError, match="not received"):
        measure_length(contact, missing, (20.5, 10.0), (20.5, 50.0))
    assert measure_length(contact, missing, (21.5, 10.0), (21.5, 50.0)).value_m == pytest.approx(2.0)
