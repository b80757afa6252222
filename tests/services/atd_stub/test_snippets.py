"""The records of atd_stub: position with its error, measured heights, images, and the text files beside them."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.common import eventually
from builders.joined_surveys import FEW_CANDIDATES
from builders.record_samples import BARE_CONTACT, FULL_CONTACT
from builders.xtf import write_xtf
from PIL import Image

from sonarpost.config import load
from sonarpost.detection.classifier import default_classifier
from sonarpost.detection.detector import FilterScores, detect
from sonarpost.detection.settings import DetectorSettings, DetectorTuning, load_settings
from sonarpost.detection.snippets import ground_projected_image
from sonarpost.detection.stream import FileOrigin, contact_record
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.messages import Contact, Pixels, Snippet
from sonarpost.services.atd_stub import survey_detection
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.input_folder import InputFile, StableFiles, list_input_files
from sonarpost.services.atd_stub.snippet_files import read_snippet, write_snippet
from sonarpost.sonar.geometry import Position, offset_between_m
from sonarpost.sonar.image_files import read_image, write_tiff
from sonarpost.sonar.options import ErrorBudget, Mounting
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.side_car import SideCar, contact_text, read_side_car
from sonarpost.sonar.source import load_survey
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

FEW = DetectorSettings(**FEW_CANDIDATES.model_dump())
ORIGIN = FileOrigin("ab" * 32, "line-7.xtf", "line-7")


@pytest.fixture(scope="module")
def line(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("line") / "line-7.xtf"
    write_xtf(simulate_survey(SurveySpec(seed=1, pings=200, samples=512, clutter=0)).survey, path)
    return path


def snippet_of(survey: Survey, detection, config: AtdStubConfig) -> Snippet:
    contact = contact_record(detection, ORIGIN, "uuv-1", survey.sonar_id)
    return survey_detection.snippet_of(survey, detection, ORIGIN, contact, config)


def best_contact_of(path: Path, config: AtdStubConfig, change=lambda ping: ping):
    with open_survey(path, config) as source:
        survey = load_survey(source)
    survey = replace(survey, pings=tuple(change(ping) for ping in survey.pings))
    found = detect(survey, FEW, config)[0]
    return survey, found, snippet_of(survey, found, config).contact


# The record


def test_a_contact_has_every_field_of_the_record(line):
    _, found, contact = best_contact_of(line, AtdStubConfig())
    if found.shadow_is_cut:
        pytest.fail("the best contact of this survey must have a complete shadow")
    unknown = {name for name, value in contact.model_dump().items() if value is None}
    assert unknown == {"position_note"}
    assert contact.contact_id == f"line-7-abababab-{found.ping_number}-{found.side.value}-{found.sample}"
    assert contact.height_m == pytest.approx(
        found.shadow_m * found.altitude_m / (found.slant_range_m + found.shadow_m), rel=1e-9
    )


def test_the_position_error_follows_from_the_configured_error_budget(line):
    _, _, default = best_contact_of(line, AtdStubConfig())
    assert 5 < default.position_sigma_m < 8
    _, _, precise = best_contact_of(line, AtdStubConfig(errors=ErrorBudget(position_m=0.5)))
    assert precise.position_sigma_m < default.position_sigma_m - 3
    assert (precise.lat_deg, precise.lon_deg) == (default.lat_deg, default.lon_deg)


def test_layback_moves_the_contact_back_along_the_track(line):
    _, found, plain = best_contact_of(line, AtdStubConfig())
    _, _, towed = best_contact_of(line, AtdStubConfig(mounting=Mounting(layback_m=30.0)))
    north_m, east_m = offset_between_m(Position(plain.lat_deg, plain.lon_deg), Position(towed.lat_deg, towed.lon_deg))
    bearing_deg = np.degrees(np.arctan2(east_m, north_m)) % 360
    assert np.hypot(north_m, east_m) == pytest.approx(30.0, abs=0.01)
    assert (bearing_deg - found.heading_deg) % 360 == pytest.approx(180.0, abs=0.1)
    assert towed.position_sigma_m > plain.position_sigma_m, "the position of a towed sonar is uncertain"


@pytest.mark.parametrize("missing", ["lat_deg", "heading_deg"])
def test_without_fix_or_heading_there_is_no_position(missing, line):
    def without(ping):
        return replace(ping, **({"lat_deg": None, "lon_deg": None} if missing == "lat_deg" else {missing: None}))

    _, _, contact = best_contact_of(line, AtdStubConfig(), without)
    assert (contact.lat_deg, contact.lon_deg, contact.position_sigma_m) == (None, None, None)
    assert contact.slant_range_m is not None


def test_a_truncated_shadow_gives_no_height(line):
    survey, found, _ = best_contact_of(line, AtdStubConfig())
    cut = replace(found, shadow_is_cut=True)
    contact = snippet_of(survey, cut, AtdStubConfig()).contact
    assert contact.height_m is None
    assert contact.shadow_m == found.shadow_m


def test_errors_name_invalid_survey_options_of_the_configuration(tmp_path):
    path = tmp_path / "uuv.toml"
    head = '[platform]\nid = "uuv-1"\n[atd_stub]\nport_order = "nearest_first"\nprojected_crs = "EPSG:32619"\n'
    path.write_text(head + "[atd_stub.mounting]\nlayback_m = 25\n[atd_stub.errors]\nposition_m = 1.5\n")
    _, config = load(path, "atd_stub", AtdStubConfig, {})
    assert (config.mounting.layback_m, config.errors.position_m) == (25.0, 1.5)
    assert (config.port_order, config.projected_crs) == ("nearest_first", "EPSG:32619")
    _, config = load(path, "atd_stub", AtdStubConfig, {"SONARPOST_ATD_STUB__MOUNTING": "{ forward_m = -2.0 }"})
    assert config.mounting == Mounting(forward_m=-2.0)
    for line_of, value in (("layback_m", "-1"), ("layback", "5")):
        path.write_text(head + f"[atd_stub.mounting]\n{line_of} = {value}\n")
        with pytest.raises(ConfigError, match=rf"uuv\.toml:7: atd_stub\.mounting\.{line_of}: got"):
            load(path, "atd_stub", AtdStubConfig, {})


def test_settings_of_the_detector_are_configured(tmp_path):
    path = tmp_path / "uuv.toml"
    values = DetectorTuning().model_dump(mode="json")
    # Every setting can be configured: each is written with another value.
    changed = json.loads(json.dumps(values), parse_float=lambda text: float(text) * 1.5, parse_int=lambda n: int(n) + 1)
    changed |= {"classifier": "/srv/classifier.npz", "classifier_identity": "0123456789abcdef"}
    assert all(changed[name] != value for name, value in values.items())
    own = "confidence_threshold = 0.5\njoin_overlap_pings = 100\n"
    lines = "".join(f"{name} = {json.dumps(value)}\n" for name, value in changed.items())
    path.write_text(f'[platform]\nid = "uuv-1"\n[atd_stub]\n{own}[atd_stub.detector]\n{lines}')
    _, config = load(path, "atd_stub", AtdStubConfig, {})
    settings = config.detector_settings()
    assert settings == DetectorSettings(**changed, confidence_threshold=0.5, join_overlap_pings=100)
    assert {name: settings.model_dump(mode="json")[name] for name in values} == changed
    (tmp_path / "settings.toml").write_text(lines + own)
    assert load_settings(tmp_path / "settings.toml") == settings, "the command reads the same keys"


def test_another_classifier_than_configured_stops_the_start(start_service, tmp_path):
    path = tmp_path / "classifier.npz"
    np.savez_compressed(path, **default_classifier().weights)
    tuning = DetectorTuning(classifier=str(path), classifier_identity="0" * 16)
    with pytest.raises(ConfigError, match="identity: got"):
        start_service(detector=tuning)


# Images with square pixels on the ground


def flat_survey(rows=300, along_m=0.1, altitude_m=4.0, samples=400, range_m=20.0) -> Survey:
    """Make a flat seabed with one bright square metre at 12 m ground range in row 150."""
    slant_m = (np.arange(samples) + 0.5) * range_m / samples
    ground_m = np.sqrt(np.maximum(slant_m**2 - altitude_m**2, 0.0))
    echo = np.full((rows, samples), 100, dtype=np.uint16)
    along = (np.arange(rows) - 150) * along_m
    echo[np.ix_(np.abs(along) <= 0.5, np.abs(ground_m - 12.0) <= 0.5)] = 10_000
    pings = tuple(
        Ping(
            row,
            1.0e9 + row * 0.1,
            (ChannelPing(Side.PORT, echo[row], range_m),),
            lat_deg=60.0 + row * along_m / 111_412.0,
            lon_deg=5.0,
            heading_deg=0.0,
            altitude_m=altitude_m,
            speed_mps=along_m / 0.1,
        )
        for row in range(rows)
    )
    return Survey(Path("flat.xtf"), "flat", "flat", pings)


@pytest.fixture(scope="module")
def detection(line):
    return best_contact_of(line, AtdStubConfig())[1]


def contact_at(survey: Survey, row: int, ground_m: float, found):
    channel = survey.pings[row].channel(Side.PORT)
    slant_m = np.hypot(ground_m, survey.pings[row].altitude_m)
    along_m = survey.pings[0].speed_mps * 0.1
    return replace(
        found,
        side=Side.PORT,
        ping_index=row,
        sample=int(slant_m / channel.sample_spacing_m),
        slant_range_m=float(slant_m),
        ground_range_m=ground_m,
        altitude_m=survey.pings[row].altitude_m,
        pixel_along_m=along_m,
        pixel_across_m=channel.sample_spacing_m,
        scores=FilterScores(*([1.0] * len(FilterScores.__dataclass_fields__))),
    )


@pytest.mark.parametrize(("along_m", "altitude_m"), [(0.04, 8.0), (0.1, 2.0), (0.4, 8.0)])
def test_a_square_metre_is_a_centred_square_at_any_speed_and_altitude(along_m, altitude_m, detection):
    survey = flat_survey(along_m=along_m, altitude_m=altitude_m)
    image = ground_projected_image(survey, contact_at(survey, 150, 12.0, detection), 80, 60, 0.1)
    bright = np.argwhere(image > 128)
    low, high = bright.min(axis=0), bright.max(axis=0) + 1
    assert image.shape == (80, 60)
    height, width = high - low
    assert height == pytest.approx(10, abs=1 + along_m / 0.1)
    assert width == pytest.approx(10, abs=2)
    np.testing.assert_allclose((low + high) / 2, (40, 30), atol=1 + along_m / 0.1)


@pytest.mark.parametrize("pixel_m", [0.0, 0.1])
def test_the_expanded_image_shows_twice_the_ground(pixel_m, detection):
    survey = flat_survey()
    config = AtdStubConfig(snippet_height_px=60, snippet_width_px=60, snippet_pixel_m=pixel_m)
    record = snippet_of(survey, contact_at(survey, 150, 12.0, detection), config)
    sizes = []
    for raster in (record.pixels, record.wide):
        bright = np.argwhere(raster.to_array() > 128)
        sizes.append(bright.max(axis=0) + 1 - bright.min(axis=0))
    assert (record.wide.height_px, record.wide.width_px) == (60, 60)
    # The square metre has half as many pixels in each direction, at the same place.
    np.testing.assert_allclose(sizes[1], sizes[0] / 2, atol=1.5)
    np.testing.assert_allclose(np.mean(np.argwhere(record.wide.to_array() > 128), axis=0)[0], 30, atol=1.5)
    assert record.contact.pixel_across_m == (pixel_m or 20.0 / 400)


def test_without_more_seabed_in_the_survey_there_is_no_expanded_image(detection):
    survey = flat_survey()
    config = AtdStubConfig(snippet_height_px=300, snippet_width_px=60)
    assert snippet_of(survey, contact_at(survey, 150, 12.0, detection), config).wide is None


def test_unrecorded_seabed_is_black(detection):
    survey = flat_survey()
    at_the_end = ground_projected_image(survey, contact_at(survey, 290, 12.0, detection), 80, 60, 0.1)
    assert (at_the_end[52:] == 0).all()
    at_the_nadir = ground_projected_image(survey, contact_at(survey, 150, 1.0, detection), 80, 60, 0.1)
    assert (at_the_nadir[:, :19] == 0).all()
    assert at_the_nadir[:, 22:].any()
    far = ground_projected_image(survey, contact_at(survey, 150, 19.5, detection), 80, 60, 0.1)
    assert (far[:, -20:] == 0).all()


def test_no_ground_projection_without_altitude_or_travel_or_with_tiny_pixels(detection):
    survey = flat_survey()
    found = contact_at(survey, 150, 12.0, detection)
    assert ground_projected_image(survey, replace(found, altitude_m=None), 80, 60, 0.1) is None
    assert ground_projected_image(survey, replace(found, pixel_along_m=None), 80, 60, 0.1) is None
    assert ground_projected_image(survey, found, 80, 60, 1e-5) is None


def test_the_record_has_the_pixel_size_of_its_image(line):
    survey, found, native = best_contact_of(line, AtdStubConfig())
    config = AtdStubConfig(snippet_pixel_m=0.05, snippet_height_px=64, snippet_width_px=96)
    sent = snippet_of(survey, found, config)
    assert (sent.contact.pixel_along_m, sent.contact.pixel_across_m) == (0.05, 0.05)
    assert (sent.pixels.height_px, sent.pixels.width_px) == (64, 96)
    assert (native.pixel_along_m, native.pixel_across_m) == (found.pixel_along_m, found.pixel_across_m)


# The text file


@pytest.mark.parametrize("contact", [FULL_CONTACT, BARE_CONTACT])
def test_a_written_text_file_reads_back_equal(contact, tmp_path):
    path = tmp_path / "c.txt"
    text = contact_text(contact)
    assert ("time_utc: 2016-10-12T09:00:00.250Z\n" in text) == (contact is FULL_CONTACT)
    assert "None" not in text
    path.write_text(text)
    assert read_side_car(path, "other", contact.vehicle_id) == SideCar(contact, ())


def test_a_handwritten_text_file_may_have_few_fields(tmp_path):
    path = tmp_path / "c.txt"
    path.write_text(
        "\ufeff lat_deg :41.5\nlon_deg: -70\n\nseen_by: diver\nvehicle_id: uuv-9\ntime_utc: 2016-10-12T09:20\n"
    )
    side_car = read_side_car(path, "c1", "uuv-1")
    assert side_car.notes == ("line 4 ignored: 'seen_by' is not a field of a contact",)
    assert side_car.contact == Contact(
        contact_id="c1", vehicle_id="uuv-1", lat_deg=41.5, lon_deg=-70.0, time_utc_s=1476264000.0
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("lon_deg: 1\nlat_deg: 91\n", "c.txt line 2: lat_deg: got 91, expected"),
        ("\nlat_deg: north\n", "c.txt line 2: lat_deg: got 'north', expected a number"),
        ("lat_deg: nan\n", "lat_deg"),
        ("ping_number: 1.5\n", "ping_number"),
        ("channel: middle\n", "channel: got 'middle'"),
        ("time_utc: yesterday\n", "time_utc: got 'yesterday', expected a time as"),
        ("what is this\n", "c.txt line 1: got 'what is this', expected name: value"),
        ("x" * 70_000, "larger than 65536 bytes"),
        (b"\xff\xfe\x00", "UTF-8"),
    ],
)
def test_errors_name_the_invalid_line_or_field_of_a_text_file(text, expected, tmp_path):
    path = tmp_path / "c.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(SurveyFileError, match=r"c\.txt( line \d)?: ") as caught:
        read_side_car(path, "c1", "uuv-1")
    assert expected in str(caught.value)


def test_the_file_name_of_a_snippet_is_its_contact_id_without_path_separators(tmp_path):
    image = np.arange(400, dtype=np.uint8).reshape(20, 20)
    contact = Contact(contact_id="../a b/ü", vehicle_id="uuv-1", lat_deg=1.0)
    tiff = write_snippet(tmp_path / "new" / "out", Snippet(contact=contact, pixels=Pixels.from_array(image)))
    assert tiff.parent == tmp_path / "new" / "out"
    np.testing.assert_array_equal(read_image(tiff), image)
    assert read_side_car(tiff.with_suffix(".txt"), "x", "uuv-1").contact == contact


@pytest.mark.parametrize(("fit", "shape", "scale"), [("resize", (256, 512), 2.5), ("crop", (512, 512), 1.0)])
def test_a_large_colour_image_is_fitted_and_its_pixel_size_corrected(fit, shape, scale, tmp_path, texture):
    large = np.dstack([texture(640, 1280)] * 2 + [texture(640, 1280) // 2])
    Image.fromarray(large).save(tmp_path / "p.jpg")
    (tmp_path / "p.txt").write_text("lat_deg: 56.4\nlon_deg: -5.6\npixel_along_m: 0.1\npixel_across_m: 0.05\nby: me\n")
    file = read_snippet(tmp_path / "p.jpg", "ab" * 32, "uuv-1", fit)
    contact = file.snippet.contact
    assert file.snippet.pixels.to_array().shape == shape
    assert (contact.lat_deg, contact.lon_deg) == (56.4, -5.6)
    assert contact.pixel_along_m == pytest.approx(0.1 * scale)
    assert contact.pixel_across_m == pytest.approx(0.05 * scale)
    assert len(file.notes) == 3
    assert "colour" in file.notes[0]
    assert "1280 × 640 px" in file.notes[1]
    assert "'by'" in file.notes[2]


def test_a_pixel_size_that_becomes_too_large_is_an_error(tmp_path, texture):
    (tmp_path / "p.txt").write_text("pixel_along_m: 99\n")
    write_tiff(tmp_path / "p.tiff", texture(40, 600))
    with pytest.raises(SurveyFileError, match=r"p\.txt: pixel size: got '116\.471 m'"):
        read_snippet(tmp_path / "p.tiff", "ab" * 32, "uuv-1", "resize")


# The service


def test_stored_snippets_can_be_sent_again_with_their_positions(start_service, runner, compressor, tmp_path, line):
    service = start_service(snippet_dir=tmp_path / "kept", confidence_threshold=0.3, max_contacts=2)
    os.link(line, tmp_path / "incoming" / "line-7.xtf")
    eventually(lambda: len(compressor.received) == 2)
    runner.stop(service)
    first = {s.contact.contact_id: s for s in compressor.received}
    assert sorted(p.name for p in (tmp_path / "kept").iterdir()) == sorted(
        f"{name}.{suffix}" for name in first for suffix in ("tiff", "txt")
    )
    start_service(mode="snippets", input_dir=tmp_path / "kept")
    eventually(lambda: len(compressor.received) == 4)
    for again in compressor.received[2:]:
        before = first[again.contact.contact_id]
        assert again.pixels == before.pixels
        assert again.contact.model_copy(update={"time_utc_s": 0.0}) == before.contact.model_copy(
            update={"time_utc_s": 0.0}
        )
        assert again.contact.time_utc_s == pytest.approx(before.contact.time_utc_s, abs=0.001)


def test_a_done_marker_completes_a_file_and_can_be_required(tmp_path):
    (tmp_path / "a.xtf").write_bytes(b"x")
    (tmp_path / "b.xtf").write_bytes(b"x")
    (tmp_path / "a.xtf.done").write_bytes(b"")
    files = list_input_files(tmp_path, (".xtf",)).files
    assert {file.path.name: file.is_done for file in files} == {"a.xtf": True, "b.xtf": False}
    names = lambda found: [file.path.name for file in found]  # noqa: E731
    assert names(StableFiles(5.0).update(files, 0.0)) == ["a.xtf"]
    with_marker = StableFiles(5.0, require_done_marker=True)
    assert names(with_marker.update(files, 0.0)) == ["a.xtf"]
    assert names(with_marker.update(files, 100.0)) == ["a.xtf"]
    done = tuple(replace(file, is_done=True) for file in files)
    assert names(with_marker.update(done, 101.0)) == ["a.xtf", "b.xtf"]
    assert InputFile(Path("a"), 1, 2, is_done=True) == InputFile(Path("a"), 1, 2), (
        "the marker does not make it another file"
    )
