"""A day of eight vehicles in one water: nothing is lost, nobody starves, memory stays flat."""

from __future__ import annotations

import pytest

from research.mission import MissionSpec, Traffic, run_mission
from sonarpost.errors import ConfigError


@pytest.fixture(scope="module")
def day():
    return run_mission(MissionSpec())


def test_every_contact_of_a_day_is_seen_and_every_picture_becomes_whole(day):
    assert day.previews.offered > 250
    assert day.previews.delivered == 1.0
    assert day.pictures.delivered == 1.0
    assert not day.unfinished_at
    assert day.left == 0
    assert max(day.pictures.delays_s) < 3600.0


def test_pictures_sent_while_the_vehicles_heard_nobody_are_repaired_when_they_do():
    spec = MissionSpec(hours=14.0, deaf_hours=4.0)
    result = run_mission(spec)
    # Until a vehicle has heard a report it sends each picture once, cut to what its frames hold.
    assert sum(delay_s > 1800.0 for delay_s in result.pictures.delays_s) > 20
    assert result.pictures.delivered == 1.0
    assert result.previews.delivered == 1.0
    assert result.left == 0


def test_messages_get_through_and_the_urgent_ones_soon(day):
    assert sum(account.offered for account in day.messages.values()) > 1000
    assert all(account.delivered > 0.99 for account in day.messages.values())
    assert day.expired == 0
    alarms = sorted(day.messages["alarm"].delays_s)
    # One turn of the slots lasts 67.5 s.
    assert alarms[len(alarms) // 2] < 2 * 67.5
    assert max(day.messages["log"].delays_s) < 2 * 3600.0


def test_memory_is_flat_and_restarts_cost_nothing(day):
    assert day.restarts == 24
    assert max(day.state_bytes[12:]) < 1.5 * max(day.state_bytes[8:12])


def test_a_flood_of_one_program_starves_neither_others_nor_pictures():
    flood = Traffic("flood", 20.0, 55, 3, 600.0)
    quiet = Traffic("quiet", 1200.0, 24, 3, 1800.0)
    result = run_mission(MissionSpec(vehicles=4, hours=8.0, traffic=(flood, quiet), loss=0.2, burst_frames=1.0))
    assert result.messages["flood"].delivered < 0.9, "more than the water holds"
    assert result.messages["quiet"].delivered > 0.95
    assert result.previews.delivered == 1.0
    assert result.pictures.delivered == 1.0


def test_the_same_specification_gives_the_same_day():
    spec = MissionSpec(vehicles=2, hours=3.0, seed=5)
    assert run_mission(spec) == run_mission(spec)


@pytest.mark.parametrize(
    "wrong", [{"vehicles": 0}, {"hours": 0.0}, {"loss": 1.0}, {"burst_frames": 0.5}, {"deaf_hours": -1}]
)
def test_values_out_of_range_are_named(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        MissionSpec(**wrong)
