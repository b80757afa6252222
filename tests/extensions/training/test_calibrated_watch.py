"""Calibrated watch: sealed contacts among those of the vehicles."""

import random

import pytest
from builders.console import FIRST_UTC_S, Clock, contact_ids, image_record

from sonarpost.extensions.training import sealed_images
from sonarpost.extensions.training.calibrated_watch import DELAY_S, CalibratedWatch
from sonarpost.services.console.service import watches
from sonarpost.services.console.store.contacts import ContactFilter


@pytest.fixture
def clock(console):
    return Clock(console)


@pytest.fixture
def short_surveys(monkeypatch):
    """Surveys of the watch with fewer pings."""
    monkeypatch.setattr(sealed_images, "PINGS", 400)


def test_console_finds_the_watch():
    assert watches().get("calibrated") is CalibratedWatch


def test_watch_adds_a_sealed_contact_of_the_kind_of_the_vehicles(console, short_surveys):
    watch = CalibratedWatch(console.state, share=1.0, draws=random.Random(3))
    reference = image_record("00A7", total=120)
    console.state.store_image(reference)
    watch.contact_arrived(reference, now_s=0.0)
    watch.step(DELAY_S[0] - 1.0)
    assert set(contact_ids(console.state)) == {"00A7"}
    watch.step(DELAY_S[1])
    [added] = set(contact_ids(console.state)) - {"00A7"}
    rows = {row["image_id"]: row for row in console.state.list_contacts(ContactFilter())["items"]}
    record = console.state.image(str(rows[added]["id"]), 1)
    assert (record.pixels.height_px, record.pixels.width_px) == (40, 60)
    assert (record.bytes_received, record.complete, record.vehicle_id) == (120, True, "uuv-1")
    assert record.notes == ()
    assert record.contact is not None
    assert record.contact.position_sigma_m == reference.contact.position_sigma_m
    assert rows[added]["looks"] == 1


def test_watch_answers_a_request_for_a_sealed_contact(console, clock, short_surveys):
    watch = CalibratedWatch(console.state, share=1.0, draws=random.Random(3))
    watch.contact_arrived(image_record("00A7", total=120), now_s=0.0)
    watch.step(DELAY_S[1])
    (row,) = console.state.list_contacts(ContactFilter())["items"]
    anna = console.browser("anna")
    assert anna.post(f"/api/contacts/{row['id']}/requests", {"kind": "refine", "airtime_s": 20.0}).status_code == 201
    states = []
    for age_s in (1.0, 5.0, 25.0):
        clock.now_utc_s = FIRST_UTC_S + age_s
        watch.step(DELAY_S[1])
        states.append(anna.contact(row["id"])["requests"][0]["state"])
    assert states == ["waiting", "sent", "confirmed"]
    versions = anna.contact(row["id"])["versions"]
    assert [version["bytes_received"] for version in versions] == [120, 240]


def test_share_of_the_watch(console):
    watch = CalibratedWatch(console.state, share=0.25, draws=random.Random(1))
    for number in range(200):
        watch.contact_arrived(image_record(f"{number:04d}"), now_s=float(number))
    # 50 are expected, and no more wait.
    assert 35 <= len(watch._waiting) <= 50


@pytest.mark.parametrize("changes", [{"position": None}, {"pixel_along_m": None}])
def test_contact_without_position_or_pixel_size_is_not_imitated(console, changes):
    watch = CalibratedWatch(console.state, share=1.0, draws=random.Random(1))
    watch.contact_arrived(image_record("00A7", **changes), now_s=0.0)
    watch.step(1e6)
    assert set(contact_ids(console.state)) == set()
