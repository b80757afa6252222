"""The outcome of a demo: which images count as missing, incomplete or not sent."""

import json

import numpy as np
import pytest

from sonarpost.codec import encode
from sonarpost.extensions.simulation.demo.outcome import evaluate
from sonarpost.extensions.simulation.demo.settings import UUV_ADDRESS, ChainSettings
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.sender import plan_packets

ENCODED = {"0001": "contact-1", "0002": "contact-2"}


def store_image(folder, image_id, *, version=1, complete=True, missing_fraction=0.0, pixels=b"pixels"):
    folder.mkdir(parents=True, exist_ok=True)
    fields = {"image_id": image_id, "complete": complete, "missing_fraction": missing_fraction}
    (folder / f"uuv-1_{image_id}_v{version}.json").write_text(json.dumps(fields))
    (folder / f"uuv-1_{image_id}_v{version}.tiff").write_bytes(pixels)


def store_at_both(settings, image_id, *, complete=True):
    for folder in (settings.vessel_images, settings.shore_images):
        store_image(folder, image_id, complete=complete)


def outcome_of(settings, contacts=("contact-1", "contact-2")):
    return evaluate(settings, contacts, ENCODED, elapsed_s=1.0)


def test_succeeds_when_every_image_is_complete(tmp_path):
    settings = ChainSettings(tmp_path, loss=0.3)
    for image_id in ENCODED:
        store_at_both(settings, image_id)
    outcome = outcome_of(settings)
    assert outcome.succeeded
    assert (outcome.contacts, outcome.images_shore, outcome.images_complete) == (2, 2, 2)
    assert "missing" not in json.loads(outcome.as_json())
    outcome = outcome_of(settings, ("contact-1", "contact-2", "contact-3"))
    assert outcome.not_sent == ("contact-3",)
    assert not outcome.succeeded


@pytest.mark.parametrize("link", ["v1", "paper"])
def test_image_that_is_absent_is_missing_with_v1_only(tmp_path, link):
    settings = ChainSettings(tmp_path, link=link, loss=0.3)
    store_at_both(settings, "0001")
    outcome = outcome_of(settings)
    # The paper's link does not repeat: no frame of this image was delivered.
    assert outcome.missing == (("0002",) if link == "v1" else ())
    assert outcome.succeeded == (link == "paper")


@pytest.mark.parametrize(("link", "loss", "incomplete"), [("v1", 0.3, True), ("v1", 1.0, False), ("paper", 0.3, False)])
def test_incomplete_image_is_a_failure_where_the_link_repeats(tmp_path, link, loss, incomplete):
    settings = ChainSettings(tmp_path, link=link, loss=loss)
    store_at_both(settings, "0001")
    store_at_both(settings, "0002", complete=False)
    outcome = outcome_of(settings)
    assert outcome.incomplete == (("0002",) if incomplete else ())
    assert outcome.succeeded != incomplete


def test_image_of_which_a_frame_was_delivered_is_missing(tmp_path):
    settings = ChainSettings(tmp_path, link="paper")
    stream = encode(np.full((16, 16), 90, np.uint8), "vq")
    frame = plan_packets("0001", stream, ContactSummary(height_px=16, width_px=16), 3, 64)[0][0]
    entry = {"event": "packet", "source": UUV_ADDRESS, "packet": 1, "kind": "data", "airtime_s": 6.1, "heard": True}
    entry["frames"] = [{"fate": "intact", "hex": frame.hex()}]
    settings.channel_log.parent.mkdir(parents=True)
    settings.channel_log.write_text(json.dumps(entry) + "\n")
    outcome = outcome_of(settings)
    assert outcome.missing == ("0001",)
    assert not outcome.succeeded


@pytest.mark.parametrize(
    ("at_shore", "succeeds"),
    [([9, 10], True), ([10], True), ([9], False), ([9, 10, 11], False), ([1, 10], False)],
    ids=["all", "last", "earlier only", "one more than the vessel", "another one before the last"],
)
def test_last_version_is_at_the_shore_and_an_earlier_one_may_have_been_replaced(tmp_path, at_shore, succeeds):
    settings = ChainSettings(tmp_path)
    store_at_both(settings, "0002")
    for folder, versions in ((settings.vessel_images, [9, 10]), (settings.shore_images, at_shore)):
        for version in versions:
            store_image(folder, "0001", version=version, pixels=b"%d" % version)
    assert outcome_of(settings).sha256_match == succeeds
    assert outcome_of(settings).succeeded == succeeds
    store_image(settings.shore_images, "0001", version=10, pixels=b"other")
    assert not outcome_of(settings).sha256_match


def test_image_without_a_pixel_does_not_count_as_received(tmp_path):
    settings = ChainSettings(tmp_path, link="paper", loss=0.3)
    store_at_both(settings, "0001")
    for folder in (settings.vessel_images, settings.shore_images):
        store_image(folder, "0002", complete=False, missing_fraction=1.0)
    outcome = outcome_of(settings)
    assert (outcome.images_vessel, outcome.images_shore, outcome.images_complete) == (1, 1, 1)
    assert outcome.succeeded
