"""Rendering of images, and measurements on them."""

from __future__ import annotations

import io
import math

import numpy as np
import pytest
from builders.console import image_record
from PIL import Image

from sonarpost.messages import Contact
from sonarpost.review import rendering
from sonarpost.review.measurement import NotMeasurableError, height_from_shadow, measure_length

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"
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


def test_masks_of_missing_and_guessed_pixels(anna):
    missing = pixels_of(anna.get(f"{VERSION}/mask.png"))
    assert (missing[:-10] == 0).all()
    assert (missing[-10:] == 255).all()
    assert (pixels_of(anna.get(f"{VERSION}/mask.png", kind="guessed")) == 0).all()
    guessed = pixels_of(anna.get(f"{VERSION}/mask.png", kind="guessed", layer="enhanced"))
    assert (guessed == 255 - missing).all()


def test_thumbnail_hatches_missing_areas(anna):
    small = pixels_of(anna.get(f"{VERSION}/thumbnail.png"))
    assert max(small.shape) <= 96
    assert (small[-9:] > 60).all()


@pytest.mark.parametrize("name", rendering.MAPS)
def test_colour_maps_are_monotonic(name):
    ramp = np.arange(256, dtype=np.uint8)[None, :]
    colours = rendering.render(ramp, name)
    assert colours.shape == ((1, 256) if name == "grey" else (1, 256, 3))
    levels = colours.reshape(256, -1).astype(int).sum(axis=1)
    steps = np.diff(levels)
    assert (steps <= 0).all() if name == "inverse" else (steps >= 0).all()


def test_black_and_white_point_and_gamma():
    ramp = np.arange(256, dtype=np.uint8)[None, :]
    narrow = rendering.render(ramp, low_percent=20, high_percent=60)[0]
    assert (narrow[:51] == 0).all()
    assert (narrow[154:] == 255).all()
    assert rendering.render(ramp, gamma=0.5)[0, 64] == 128


def test_sixteen_bits_become_the_most_significant_eight():
    pixels = np.array([[0, 255, 256, 65535]], np.uint16)
    assert rendering.eight_bits(pixels).tolist() == [[0, 0, 1, 255]]


@pytest.mark.parametrize(
    ("name", "value"), [("low", "100"), ("gamma", "0"), ("map", "jet"), ("layer", "best"), ("high", "x")]
)
def test_error_names_the_invalid_parameter(anna, name, value):
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
    assert 0 < found["sigma_m"] < 0.1
    assert 0 < found["height_sigma_m"] < 0.1
    assert found["id"] is None
    assert anna.contact(ID)["measurements"] == []


def test_stored_measurement_is_in_the_audit(anna):
    found = measure(anna, kind="length", **{"from": [0.0, 10.0], "to": [20.0, 10.0]}, keep=True).json()
    assert (found["value_m"], found["height_m"]) == (pytest.approx(2.0), None)
    detail = anna.contact(ID)
    assert detail["measurements"] == [found]
    [entry] = detail["audit"]
    assert (entry["action"], entry["user"], entry["detail"]["value_m"]) == ("measure", "anna", found["value_m"])


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"layer": "enhanced"}, "layer"),
        ({"to": [38.0, 50.0]}, "line"),
        ({"to": [10.0, 10.0]}, "to"),
        ({"to": [10.0, 60.5]}, "to"),
        ({"layer": "grain"}, "layer"),
    ],
)
def test_missing_or_synthesised_pixels_are_not_measurable(anna, changes, field):
    answer = measure(anna, **changes)
    assert answer.status_code == 409
    assert (answer.json()["measurable"], answer.json()["error"]["field"]) == (False, field)


def test_unknown_pixel_size_is_not_measurable(console):
    console.state.store_image(image_record(pixel_along_m=None))
    answer = measure(console.browser("anna"))
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


def test_length_uncertainty_equals_a_monte_carlo_simulation():
    contact = Contact(contact_id="c", vehicle_id="v", pixel_along_m=0.1, pixel_across_m=0.05)
    missing = np.zeros((200, 200), np.bool_)
    length = measure_length(contact, missing, (50, 50), (90, 130))
    rng = np.random.default_rng(1)
    clicks = rng.normal(0, 0.7, (20_000, 4))
    scale = rng.normal(1, 0.025, 20_000)
    lengths = scale * np.hypot((40 + clicks[:, 0] - clicks[:, 1]) * 0.1, (80 + clicks[:, 2] - clicks[:, 3]) * 0.05)
    assert length.sigma_m == pytest.approx(lengths.std(), rel=0.05)
    assert math.hypot(length.along_m, length.across_m) == pytest.approx(length.value_m)


def test_line_over_one_missing_pixel_is_rejected():
    contact = Contact(contact_id="c", vehicle_id="v", pixel_along_m=0.1, pixel_across_m=0.05)
    missing = np.zeros((40, 60), np.bool_)
    missing[20, 30] = True
    with pytest.raises(NotMeasurableError, match="not received"):
        measure_length(contact, missing, (20.5, 10.0), (20.5, 50.0))
    assert measure_length(contact, missing, (21.5, 10.0), (21.5, 50.0)).value_m == pytest.approx(2.0)
