"""Two vessels that receive one vehicle: merged frames make images complete, with less air time."""

import pytest

from research import two_vessels
from research.two_vessels import WAYS, TwoVesselsSpec, measure
from sonarpost.errors import ConfigError


def test_merged_images_are_complete_where_those_of_each_vessel_are_not() -> None:
    result = measure(TwoVesselsSpec(), seed=1)
    assert result.complete == {"vessel-1": 0.0, "vessel-2": 0.0, "merged": 1.0}
    received = result.received_bytes
    assert received["merged"] > 2 * max(received["vessel-1"], received["vessel-2"])
    assert result.air_s["merged"] < min(result.air_s["vessel-1"], result.air_s["vessel-2"])


def test_delay_of_the_second_vessel_changes_no_image() -> None:
    late, early, again = (measure(TwoVesselsSpec(images=6, delay_frames=n), seed=3) for n in (300, 0, 0))
    assert again == early
    assert late.complete == early.complete
    assert late.received_bytes == early.received_bytes


def test_command_prints_each_way_and_values_out_of_range_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert two_vessels.main(["--seeds", "1", "--images", "4"]) == 0
    assert tuple(line.split()[0] for line in capsys.readouterr().out.splitlines()[-3:]) == WAYS
    for options in ({"loss": 0.95}, {"images": 0}, {"delay_frames": -1}):
        with pytest.raises(ConfigError):
            TwoVesselsSpec(**options)  # type: ignore[arg-type]
