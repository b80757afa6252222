"""Rendering of images, and measurements on them."""

import io
import math
from itertools import product
from types import SimpleNamespace

import numpy as np
import pytest
from builders.console import contact_id, image_record
from PIL import Image

from sonarpost.detection.snippets import cut_snippet
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.messages import Contact, Pixels
from sonarpost.review import rendering
from sonarpost.review.image_geometry import contact_box, contact_mark, range_axis
from sonarpost.review.measurement import NotMeasurableError, height_from_shadow, measure_length
from sonarpost.services.console.store import serialisers
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


def test_image_equals_the_received_pixels(anna):
    answer = anna.get(f"{VERSION}/image.png")
    assert (pixels_of(answer) == image_record(missing_rows=10).pixels.to_array()).all()
    assert "immutable" in answer.headers["cache-control"]
    # Sixteen bits become the most significant eight.
    assert rendering.eight_bits(np.array([[0, 255, 256, 65535]], np.uint16)).tolist() == [[0, 0, 1, 255]]


def test_mask_and_thumbnail_show_missing_pixels(anna):
    missing = pixels_of(anna.get(f"{VERSION}/mask.png"))
    assert (missing[:-10] == 0).all()
    assert (missing[-10:] == 255).all()
    # The thumbnail hatches missing areas.
    small = pixels_of(anna.get(f"{VERSION}/thumbnail.png"))
    assert max(small.shape) <= 96
    assert (small[-9:] > 60).all()


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
    # 40 x 60 px of 200 bytes, details of 2.4 px: ends, half of the blur, and 2.5 % of the pixel size.
    ends_px = math.sqrt(2) * math.hypot(0.7, 2.4 / 2.355 / 2)
    assert found["sigma_m"] == pytest.approx(math.hypot(0.05 * ends_px, 0.05), rel=0.01)
    assert 0 < found["height_sigma_m"] < 0.1
    assert found["id"] is None
    assert anna.contact(ID)["measurements"] == []
    # A shadow lies across the track.
    found = measure(anna, to=[14.0, 50.0]).json()
    assert (found["to"], found["along_m"], found["snapped"]) == ([10.0, 50.0], 0.0, [True, True])


def test_ends_move_to_half_brightness_and_beam_and_blur_are_subtracted(make_console):
    image = image_record()
    pixels = np.full((40, 60), 60, np.uint8)
    pixels[10:26, 20:26] = 200
    console = make_console(beam_width_deg=0.5)
    packed = Pixels.from_array(pixels)
    console.state.store_image(image.model_copy(update={"pixels": packed, "pixels_sha256": packed.sha256}))
    anna = console.browser("anna")
    found = measure(anna, kind="length", **{"from": [7.5, 23.0], "to": [27.0, 23.0]}).json()
    # The middle of the last dark and the first bright row.
    assert (found["from"], found["to"]) == ([pytest.approx(10.0), 23.0], [pytest.approx(26.0), 23.0])
    assert found["snapped"] == [True, True]
    # 16 rows of 0.1 m. Beam of 0.5° at 13 m, and near the vehicle; details of 2.4 px.
    assert found["blur_m"] == pytest.approx(math.hypot(0.12, 13.0 * math.radians(0.5), 0.24))
    assert found["value_m"] == pytest.approx(math.sqrt(1.6**2 - found["blur_m"] ** 2))
    assert found["along_m"] == pytest.approx(found["value_m"])
    parts = [found[f"{name}_sigma_m"] for name in ("edge", "blur", "scale", "range")]
    assert found["sigma_m"] == pytest.approx(math.hypot(*parts))
    # An end on seabed without an edge within 7 px stays; its standard deviation is larger.
    stays = measure(anna, kind="length", **{"from": [10.5, 23.0], "to": [35.0, 23.0]}).json()
    assert (stays["to"], stays["snapped"]) == ([35.0, 23.0], [True, False])
    assert stays["edge_sigma_m"] > 2 * found["edge_sigma_m"]
    # Across the track the beam has no effect.
    width = measure(anna, kind="width", **{"from": [18.0, 18.5], "to": [18.0, 27.0]}).json()
    assert width["blur_m"] == pytest.approx(2.4 * width["across_m"] / width["value_m"] * 0.05 * 13 / 12, rel=0.05)


def test_stored_measurement_is_in_the_audit(anna):
    found = measure(anna, kind="length", **{"from": [0.0, 10.0], "to": [20.0, 10.0]}, keep=True).json()
    assert found["height_m"] is None
    detail = anna.contact(ID)
    assert detail["measurements"] == [found]
    [entry] = detail["audit"]
    assert (entry["action"], entry["user"], entry["detail"]["value_m"]) == ("measure", "anna", found["value_m"])


def test_missing_pixels_other_layers_and_unknown_sizes_are_not_measurable(anna, make_console):
    for changes, field in (
        ({"layer": "expand"}, "layer"),
        ({"kind": "length", "to": [38.0, 50.0]}, "line"),
        ({"to": [10.0, 10.0]}, "to"),
        ({"to": [10.0, 60.5]}, "to"),
    ):
        answer = measure(anna, **changes)
        assert (answer.status_code, answer.json()["error"]["code"]) == (409, "not_measurable")
        assert answer.json()["error"]["field"] == field
    other = make_console()
    other.state.store_image(image_record(pixel_along_m=None))
    answer = measure(other.browser("anna"))
    assert (answer.status_code, answer.json()["error"]["code"]) == (409, "not_measurable")


def test_height_needs_altitude_and_range():
    missing = np.zeros((40, 60), np.bool_)
    known = {"contact_id": "c", "vehicle_id": "v", "pixel_along_m": 0.1, "pixel_across_m": 0.05}
    without = Contact(**known)
    shadow = measure_length(without, missing, (0, 0), (0, 40))
    assert height_from_shadow(without, shadow) == {}
    assert height_from_shadow(Contact(**known, altitude_m=5.0), shadow) == {}
    slant = height_from_shadow(Contact(**known, altitude_m=5.0, slant_range_m=13.0), shadow)
    ground = height_from_shadow(Contact(**known, altitude_m=5.0, ground_range_m=12.0), shadow)
    assert slant == ground != {}


FAR = {"contact_id": "c", "vehicle_id": "v", "pixel_along_m": 0.1, "pixel_across_m": 0.05, "channel": "port"}


def test_length_uncertainty_equals_a_monte_carlo_simulation():
    contact = Contact(**FAR, altitude_m=5.0, ground_range_m=12.0)
    missing = np.zeros((200, 200), np.bool_)
    length = measure_length(contact, missing, (50, 50), (90, 130), (2.0, 3.0))
    rng = np.random.default_rng(1)
    count = 40_000
    ends = np.array([50, 50, 90, 130]) + rng.normal(0, 1, (count, 4)) * [2.0, 2.0, 3.0, 3.0]
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
    assert height["height_sigma_m"] > 1.0 * 5 / (12 + 1) - 1.0 * 5 / (13 + 1)


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


def test_many_versions_of_an_image_are_shown_in_part(console, monkeypatch):
    monkeypatch.setattr(serialisers, "MAX_VERSIONS", 3)
    for version in range(1, 7):
        console.state.store_image(image_record(version=version))
    detail = console.browser("watch").contact(contact_id())
    assert [one["version"] for one in detail["versions"]] == [4, 5, 6]
    assert detail["contact"]["version"] == 6
