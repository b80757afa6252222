"""Recordings split into files: a simulated seabed with boxes, and the contacts that atd_stub detects in it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from builders.xtf import write_xtf
from sonarpost.detection.settings import DetectorTuning
from sonarpost.messages import Snippet
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.survey_detection import detect_in_survey, snippets_of
from sonarpost.sonar.survey import ChannelPing, Ping, Side, Survey

START_S, PING_S, SAMPLES, RANGE_M, ALTITUDE_M, ALONG_M = 1.0e9, 0.1, 256, 20.0, 3.0, 0.1
OBJECT_SAMPLE = 150
FEW_CANDIDATES = DetectorTuning(min_matched_response=3.0)
"""Settings with which whole objects are found in a quarter of the time: the noise gives fewer candidates."""


@dataclass(frozen=True)
class Box:
    """A bright box of 8 pings and 6 samples (0.8 m x 0.5 m) with its shadow, centred on a row."""

    row: int
    side: Side = Side.PORT


def survey_of(rows: int, *boxes: Box, seed: int = 5, first_row: int = 0) -> Survey:
    """Return a seabed of speckle with boxes; row 0 is at START_S."""
    rng = np.random.default_rng(seed)
    images = {}
    for side in Side:
        mean = np.ones((rows, SAMPLES))
        for box in boxes:
            if box.side is side:
                span = slice(box.row - 4, box.row + 4)
                mean[span, OBJECT_SAMPLE - 3 : OBJECT_SAMPLE + 3] = 5.0
                mean[span, OBJECT_SAMPLE + 3 : OBJECT_SAMPLE + 23] = 0.04
        ranges = (np.arange(SAMPLES) + 0.5) * RANGE_M / SAMPLES
        mean *= 1.0 / (1.0 + ranges / 8.0)
        mean[:, ranges < ALTITUDE_M] = 0.004
        images[side] = np.clip(mean * rng.rayleigh(0.8, mean.shape) * 4000, 0, 65535).astype(np.uint16)
    pings = tuple(
        Ping(
            number=row,
            time_utc_s=START_S + row * PING_S,
            channels=tuple(ChannelPing(side, images[side][row], RANGE_M) for side in Side),
            lat_deg=60.0 + row * ALONG_M / 111_412.0,
            lon_deg=5.0,
            heading_deg=0.0,
            altitude_m=ALTITUDE_M,
            depth_m=12.0,
            speed_mps=ALONG_M / PING_S,
        )
        for row in range(first_row, rows)
    )
    return Survey(Path("made.xtf"), "made", "made", pings)


def split(folder: Path, survey: Survey, *spans: tuple[int, int], sonar: str = "") -> list[Path]:
    """Write parts of a survey as the consecutive files of a recorder."""
    paths = []
    for number, (first, end) in enumerate(spans):
        part = replace(survey, pings=survey.pings[first:end], sonar_id=sonar or survey.sonar_id)
        paths.append(folder / f"line-{number}.xtf")
        write_xtf(part, paths[-1])
    return paths


def detect_in_files(paths: list[Path], **changes) -> list[Snippet]:
    """Return the contacts of consecutive files, with those held at the end of the last one."""
    config = AtdStubConfig(**changes)
    ends, sent = {}, []
    for path in paths:
        result = detect_in_survey(path, path.stem.ljust(64, "0"), "uuv-1", config, ends)
        sent += [*result.not_continued, *result.snippets]
        ends = result.ends
    return sent + [snippet for end in ends.values() for snippet in snippets_of(end.held)]


def near(sent: list[Snippet], row: int, side: Side = Side.PORT) -> list[Snippet]:
    """Return the contacts within a metre of a box."""
    slant_m = OBJECT_SAMPLE * RANGE_M / SAMPLES
    return [
        s
        for s in sent
        if s.contact.channel == side.value
        and abs(s.contact.ping_number - row) <= 10
        and abs(s.contact.slant_range_m - slant_m) < 1.0
    ]
