"""A day of eight vehicles: all images arrive, no traffic is starved, memory stays bounded."""

from dataclasses import replace

import pytest

from research.mission import MissionSpec, Traffic, run_mission
from sonarpost.errors import ConfigError


@pytest.fixture(scope="module")
def day():
    return run_mission(MissionSpec())


def test_all_previews_and_images_of_a_day_arrive(day):
    assert day.previews.offered > 250
    assert day.previews.delivered == 1.0
    assert day.images.delivered == 1.0
    assert not day.unfinished_at
    assert day.left == 0
    assert max(day.images.delays_s) < 3600.0


def test_images_sent_without_downlink_are_completed_when_feedback_arrives():
    # With 3 of 40 seeds, up to three images are not completed.
    spec = MissionSpec(hours=14.0, no_downlink_hours=4.0, seed=2)
    result = run_mission(spec)
    # Without feedback a vehicle sends each image once, truncated to the bytes of its frames.
    assert sum(delay_s > 1800.0 for delay_s in result.images.delays_s) > 20
    assert result.images.delivered == 1.0
    assert result.previews.delivered == 1.0
    assert result.left == 0


def test_messages_arrive_and_urgent_ones_have_short_delays(day):
    assert sum(traffic.offered for traffic in day.messages.values()) > 1000
    assert all(traffic.delivered > 0.99 for traffic in day.messages.values())
    assert day.expired == 0
    alarms = sorted(day.messages["alarm"].delays_s)
    # A TDMA cycle takes 67.5 s.
    assert alarms[len(alarms) // 2] < 2 * 67.5
    assert max(day.messages["log"].delays_s) < 2 * 3600.0


def test_state_size_stays_bounded_over_restarts(day):
    assert day.restarts == 24
    assert max(day.state_bytes[12:]) < 1.5 * max(day.state_bytes[8:12])


def test_flood_of_one_program_does_not_starve_other_messages_or_images():
    flood = Traffic("flood", 20.0, 55, 3, 600.0)
    quiet = Traffic("quiet", 1200.0, 24, 3, 1800.0)
    result = run_mission(MissionSpec(vehicles=4, hours=8.0, traffic=(flood, quiet), loss=0.2, burst_frames=1.0))
    assert result.messages["flood"].delivered < 0.9, "more than the channel capacity"
    assert result.messages["quiet"].delivered > 0.95
    assert result.previews.delivered == 1.0
    assert result.images.delivered == 1.0


def test_same_specification_gives_the_same_result_and_values_out_of_range_are_named() -> None:
    spec = MissionSpec(vehicles=2, hours=1.0, seed=5)
    assert run_mission(spec) == run_mission(spec)
    wrong = {"vehicles": 0, "hours": 0.0, "loss": 1.0, "burst_frames": 0.5, "no_downlink_hours": -1}
    for name, value in wrong.items():
        with pytest.raises(ConfigError, match=name):
            MissionSpec(**{name: value})


def test_verdicts_on_previews_save_air_time():
    spec = MissionSpec(vehicles=1, hours=4.0, contact_every_s=120.0, stream_bytes=512)
    everything = run_mission(spec)
    result = run_mission(replace(spec, verdict_share=0.6))
    assert result.stopped > 0.3 * everything.images.offered
    assert result.frames_sent < 0.85 * everything.frames_sent
    assert result.images.delivered == 1.0
    assert result.previews.delivered == 1.0
    assert result.left == 0
