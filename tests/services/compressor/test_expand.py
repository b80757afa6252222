"""compressor: the expand command (kind "expand") sends more seabed around a contact as an image of its own."""

import numpy as np
import pytest
from builders.common import eventually
from builders.joined_surveys import FEW_CANDIDATES

from sonarpost.detection.detector import detect
from sonarpost.detection.settings import DetectorSettings
from sonarpost.detection.stream import FileOrigin, contact_record
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.messages import Contact, Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.survey_detection import snippet_of
from sonarpost.services.compressor.encoding import expand


@pytest.fixture
def expandable_snippet(snippet):
    """Make snippets with an expanded image, pixels of 0.05 m x 0.1 m."""

    def make(contact_id, seed=1, **changes):
        sizes = {"pixel_along_m": 0.05, "pixel_across_m": 0.1}
        contact = Contact(contact_id=contact_id, vehicle_id="uuv-1", **(sizes | changes))
        wide = snippet("expanded", seed=seed + 100).pixels
        return Snippet(contact=contact, pixels=snippet(contact_id, seed=seed).pixels, source="line", wide=wide)

    return make


def test_expand_sends_more_seabed_as_an_image_of_its_own(start_service, encoded, answer, expandable_snippet, vq):
    service = start_service()
    sent = expandable_snippet("c1")
    [first] = encoded(sent)
    expanded = answer("expand", first.image_id)
    assert int(expanded.image_id, 36) == int(first.image_id, 36) + 1
    assert expanded.contact == sent.contact.model_copy(update={"pixel_along_m": 0.1, "pixel_across_m": 0.2})
    assert expanded.stream == vq.encode(sent.wide.to_array())
    assert expanded.original_sha256 == sent.wide.sha256
    counters = service.health().counters
    assert (counters["images_encoded"], counters["images_expanded"]) == (2, 1)


def test_expand_of_a_detection_shows_twice_the_ground(start_service, encoded, command_over_the_link, emb):
    survey = simulate_survey(SurveySpec(seed=1, pings=400, samples=1024, clutter=0)).survey
    # Away from the ends of the recording, where the expanded image would be shifted.
    detection = next(
        each
        for each in detect(survey, DetectorSettings(**FEW_CANDIDATES.model_dump()))
        if 80 <= each.ping_index < 320 and 150 <= each.sample < 850
    )
    origin = FileOrigin("ab" * 32, "line-7.xtf", "line-7")
    start_service(codec="emb", budget_bytes=4000)
    contact = contact_record(detection, origin, "uuv-1", survey.sonar_id)
    [first] = encoded(snippet_of(survey, detection, origin, contact, AtdStubConfig()))
    expanded = command_over_the_link("expand", first.image_id)
    near, around = (emb.decode(image.stream).image.astype(float) for image in (first, expanded))
    assert around.shape == near.shape == (80, 140)
    assert expanded.contact.pixel_along_m == 2 * first.contact.pixel_along_m
    assert expanded.contact.pixel_across_m == 2 * first.contact.pixel_across_m
    # The first image is the middle of the expanded one at half the size, and correlates nowhere else as well.
    small = near.reshape(40, 2, 70, 2).mean(axis=(1, 3))
    correlation = {
        (row, column): np.corrcoef(small.ravel(), around[row : row + 40, column : column + 70].ravel())[0, 1]
        for row in range(0, 41, 5)
        for column in range(0, 71, 5)
    }
    assert max(correlation, key=correlation.__getitem__) == (20, 35)
    assert correlation[20, 35] > 0.8


def test_a_repeated_expand_command_sends_the_same_image(start_service, restart, encoded, answer, expandable_snippet):
    service = start_service()
    first, _ = encoded(expandable_snippet("c1"), expandable_snippet("c2", seed=2))
    expanded = answer("expand", first.image_id)
    answer("refine", first.image_id)  # replaces the cache entry
    service = restart(service)
    assert answer("expand", first.image_id) == expanded
    assert "images_encoded" not in service.health().counters


def test_an_expanded_image_that_left_the_cache_is_encoded_again(start_service, encoded, answer, expandable_snippet):
    start_service(codec="emb", budget_bytes=120, cache_images=2)
    [first] = encoded(expandable_snippet("c1"))
    expanded = answer("expand", first.image_id)
    answer("refine", first.image_id)  # now the expanded image is the oldest entry
    [other] = encoded(expandable_snippet("c2", seed=2))
    again = answer("expand", first.image_id)
    assert again.stream == expanded.stream
    assert again.image_id not in {first.image_id, expanded.image_id, other.image_id}


def test_expand_without_an_expanded_image_is_counted(
    start_service, encoded, send_command, answer, snippet, expandable_snippet
):
    service = start_service()
    plain, first = encoded(snippet("plain"), expandable_snippet("c1"))
    counters = lambda: service.health().counters  # noqa: E731
    send_command("expand", plain.image_id)
    eventually(lambda: counters().get("commands_without_expanded_image") == 1)
    send_command("expand", "ZZZZ")
    eventually(lambda: counters().get("commands_unknown_image") == 1)
    expanded = answer("expand", first.image_id)
    send_command("expand", expanded.image_id)  # an expanded image cannot be expanded again
    eventually(lambda: counters().get("commands_without_expanded_image") == 2)
    assert answer("resend", expanded.image_id) == expanded


def test_pixel_sizes_above_the_range_of_the_record_are_unknown(expandable_snippet):
    expanded = expand(expandable_snippet("c1", pixel_along_m=60.0, pixel_across_m=None))
    assert (expanded.contact.pixel_along_m, expanded.contact.pixel_across_m) == (None, None)
    assert expanded.wide is None
