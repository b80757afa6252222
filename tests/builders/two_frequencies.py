"""Surveys of dual-frequency sonars: a second channel on each side, of a lower frequency, that shows only speckle."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from builders.xtf import write_xtf
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

FIRST_HZ, SECOND_HZ = 900e3, 400e3


def with_second_frequency(survey: Survey, samples: int, range_m: float) -> Survey:
    """Return the survey with a second channel on each side, with its own number of samples and range."""
    rng = np.random.default_rng(9)

    def channels(ping: Ping) -> tuple[ChannelPing, ...]:
        noise = {c.side: (rng.rayleigh(0.8, samples) * 2000).astype(np.uint16) for c in ping.channels}
        second = (ChannelPing(side, noise[side], range_m, SECOND_HZ) for side in Side if side in noise)
        return (*(replace(c, frequency_hz=FIRST_HZ) for c in ping.channels), *second)

    return replace(survey, pings=tuple(replace(ping, channels=channels(ping)) for ping in survey.pings))


def files_of(survey: Survey, folder: Path, samples: int, range_m: float) -> tuple[Path, Path]:
    """Write a survey with its first frequency alone, and with both; return the two files of the same name."""
    paths = (folder / "alone" / "line.xtf", folder / "both" / "line.xtf")
    both = with_second_frequency(survey, samples, range_m)
    alone = replace(survey, pings=tuple(replace(p, channels=p.channels[: len(p.channels) // 2]) for p in both.pings))
    for path, recording in zip(paths, (alone, both), strict=True):
        path.parent.mkdir(exist_ok=True)
        write_xtf(recording, path)
    return paths


def read_both(survey: Survey, folder: Path, samples: int, range_m: float) -> tuple[Survey, Survey]:
    """Return the survey read from the file of its first frequency alone, and from the file of both."""
    alone, both = (read_survey(path) for path in files_of(survey, folder, samples, range_m))
    assert "2 channel sets" in both.warnings[-1]
    return alone, both
