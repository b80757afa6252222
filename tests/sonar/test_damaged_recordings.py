"""Damage of a recording is local: the pings beside a damaged span are read, and no ping is invented."""

import struct

import numpy as np
import pytest
from builders.surveys import MAKERS, small_survey
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.readers import read_survey
from sonarpost.sonar.survey import Side

PINGS = 12
FORMATS = sorted(set(MAKERS) - {"waterfall"})  # its navigation is a text, and its images are decoded as a whole
FILE_HEADER_BYTES = {"xtf": 1024, "sl2": 8, "sl3": 8}
EDITS = 4
"""Edits in each example, one after the other on the same valid file: 600 in the thorough profile."""


def _svlog_starts(data):
    """Return the start of each ping, its navigation packet, and the end of the file."""
    starts, offset = [], 0
    while offset < len(data):
        length, kind = struct.unpack_from("<HH", data, offset + 2)
        if kind == 150:
            starts.append(offset)
        offset += 10 + length
    return [*starts, len(data)]


class Recording:
    """A valid recording of a format, the pings that it has, and where their bytes are in one of its files."""

    def __init__(self, kind, folder):
        folder.mkdir(exist_ok=True)
        self.path = MAKERS[kind](small_survey(pings=PINGS), folder)
        stored = {"humminbird": self.path.with_suffix("") / "B003.SON"}
        self.stored = stored.get(kind, self.path)
        self.valid = self.stored.read_bytes()
        self.pings = [_content(ping) for ping in read_survey(self.path)]
        assert len(self.pings) == PINGS
        header = FILE_HEADER_BYTES.get(kind, 0)
        bounds = np.linspace(header, len(self.valid), PINGS + 1).astype(int).tolist()
        self.bounds = _svlog_starts(self.valid) if kind == "svlog" else bounds
        assert len(self.bounds) == PINGS + 1
        self.other_side = Side.PORT if kind == "humminbird" else None
        """The side whose bytes are in another file."""

    def check(self, data, first, end):
        """Read `data`, which differs from the valid file between the offsets `first` and `end` of the valid one."""
        self.stored.write_bytes(data)
        untouched = [
            content
            for content, start, stop in zip(self.pings, self.bounds, self.bounds[1:], strict=False)
            if stop <= first or start >= end
        ]
        touched = PINGS - len(untouched)
        try:
            read = [_content(ping) for ping in read_survey(self.path)]
        except SurveyFileError:
            assert not untouched
            return
        for content in untouched:
            assert content in read, (first, end, content[:2])
        invented = [found for found in read if not any(_is_part(found, content) for content in self.pings)]
        assert len(invented) <= 2 * touched, (first, end, [each[:2] for each in invented])


def _content(ping):
    return ping.number, round(ping.time_utc_s, 2), {c.side: c.samples.tobytes() for c in ping.channels}


def _is_part(found, content):
    """Return whether a ping has what the other one has: damage may take one side."""
    return found[:2] == content[:2] and found[2].items() <= content[2].items()


@pytest.fixture(params=FORMATS)
def recording(request, tmp_path):
    return Recording(request.param, tmp_path / "recording")


@st.composite
def edits(draw):
    """An edit: what is done, and place and length as fractions."""
    kind = draw(st.sampled_from(("delete", "insert", "overwrite", "cut")))
    place, length = draw(st.floats(0, 1)), draw(st.floats(0, 1)) ** 4
    filling = draw(st.sampled_from(("random", "zeros", "ones")))
    return kind, place, length, filling, draw(st.integers(0, 2**32 - 1))


def apply(valid, header, edit):
    """Return the data after an edit, and the span of the valid file that it touches."""
    kind, place, share, filling, seed = edit
    first = header + round(place * (len(valid) - header))
    count = max(1, round(share * (len(valid) - header)))
    end = min(first + count, len(valid))
    new = {"random": np.random.default_rng(seed).bytes(count), "zeros": bytes(count), "ones": b"\xff" * count}[filling]
    match kind:
        case "cut":
            return valid[:first], first, len(valid)
        case "delete":
            return valid[:first] + valid[end:], first, end
        case "insert":  # between two bytes: it touches the record that both are in
            return valid[:first] + new + valid[first:], first, first
        case _:
            return valid[:first] + new[: end - first] + valid[end:], first, end


@given(done=st.lists(edits(), min_size=EDITS, max_size=EDITS))
def test_pings_outside_a_damaged_span_are_read_and_none_is_invented(recording, done):
    # The first record of these has the date of the recording.
    header = recording.bounds[1] if recording.stored.suffix in (".sl2", ".sl3", ".svlog") else recording.bounds[0]
    for edit in done:
        data, first, end = apply(recording.valid, header, edit)
        recording.check(data, first, end)
