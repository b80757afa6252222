"""atd_stub: an entry of its folder that cannot be read is reported and does not affect the others."""

import os
import socket
from dataclasses import replace

import pytest
from builders.common import eventually
from builders.joined_surveys import Box, split, survey_of
from builders.survey_oracle import tiny_survey
from builders.surveys import make_xtf, small_survey
from builders.xtf import write_xtf

from sonarpost.detection.stream import _FileSearch
from sonarpost.errors import SurveyFileError
from sonarpost.services.atd_stub import survey_detection
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.survey_detection import detect_in_survey
from sonarpost.sonar.image_files import write_tiff

HOLDING = AtdStubConfig(join_timeout_s=30.0)


def description(name):
    return f'port = "{name}"\nport_order = "nearest_first"\nnavigation = "{name}"\npositions = "degrees"\n'


def weird(path, kind):
    """Make an entry of a kind at a path; its folder exists."""
    if kind == "pipe":
        os.mkfifo(path)
    elif kind == "socket":
        with socket.socket(socket.AF_UNIX) as server:
            server.bind(str(path))
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    elif kind == "loop":
        path.symlink_to(path.name)
    elif kind == "dangling":
        path.symlink_to("absent")
    elif kind == "input/output error":
        path.symlink_to("/proc/self/mem")
    elif kind == "sparse":
        with path.open("wb") as file:
            file.truncate(1 << 40)
    return path


KINDS = ("pipe", "socket", "device", "folder", "loop", "dangling", "input/output error", "sparse")


@pytest.fixture
def good(tmp_path, incoming, texture):
    """Put a good survey or image into the folder: newer than the bad entries."""

    def put(mode, name):
        if mode == "snippets":
            write_tiff(incoming / f"{name}.tiff", texture(seed=len(name)))
        else:
            make_xtf(tiny_survey(40, 400 + len(name)), tmp_path).rename(incoming / f"{name}.xtf")

    return put


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("mode", "name"),
    [
        ("survey", "bad.xtf"),
        ("survey", "bad.waterfall.toml"),
        ("survey", "bad.dat"),
        ("survey", "bad/B002.SON"),
        ("survey", "first.xtf.picks"),
        ("snippets", "bad.png"),
        ("snippets", "first.txt"),
        ("snippets", "first.tiff.done"),
    ],
)
def test_entry_affects_no_other_file(kind, mode, name, start_service, incoming, good, counter):
    (incoming / "bad").mkdir()
    (incoming / "bad.dat").write_bytes(bytes(64))
    (incoming / name).unlink(missing_ok=True)
    weird(incoming / name, kind)
    good(mode, "first")
    service = start_service(mode=mode)
    good(mode, "second")
    is_first_spoilt = name == "first.txt" and kind not in ("folder", "dangling", "loop", "pipe", "socket", "device")
    eventually(lambda: counter(service, "files_processed") == 2 - is_first_spoilt)
    if name.startswith("bad.x") and kind in ("input/output error", "sparse"):
        eventually(lambda: f"{name}: " in service.health().detail)
        assert service.health().gauges["files_unreadable"] == 1
    assert not service.failed


@pytest.mark.parametrize(
    "name",
    ["/dev/zero", "../zero", "a/b.png", "..", ".", r"a\u0000b", 255 * "é", "zero", "pipe", "loop", "closed/x"],
)
def test_description_of_a_recording_affects_no_other_recording(name, start_service, incoming, good, counter):
    for kind in ("pipe", "loop"):
        weird(incoming / kind, kind)
    weird(incoming / "zero", "device")
    (incoming / "closed").mkdir(0)
    (incoming / "bad.waterfall.toml").write_text(description(name))
    os.utime(incoming / "bad.waterfall.toml", (1e9, 1e9))
    service = start_service()
    good("survey", "good")
    eventually(lambda: counter(service, "files_processed") == 1)
    is_refused = lambda: counter(service, "files_quarantined") or "bad.waterfall.toml: " in service.health().detail  # noqa: E731
    eventually(is_refused)
    (incoming / "bad.waterfall.toml").unlink(missing_ok=True)
    eventually(lambda: service.health().state == "ok")
    assert not service.failed


def test_end_of_an_earlier_recording_does_not_spoil_the_next(tmp_path, monkeypatch):
    """The fault is in the earlier one: the next is searched alone, and the held contacts are released."""
    first, second = split(tmp_path, survey_of(200, Box(97)), (0, 100), (100, 200))
    search = _FileSearch.run

    def fail_when_joined(self, pings):
        return 1 // 0 if self._previous is not None else search(self, pings)

    monkeypatch.setattr(_FileSearch, "run", fail_when_joined)
    before = detect_in_survey(first, "0" * 64, "uuv-1", HOLDING)
    assert before.held
    after = detect_in_survey(second, "1" * 64, "uuv-1", HOLDING, before.ends)
    assert (after.joined, after.not_continued) == (False, before.held)
    assert after.ends.keys() == before.ends.keys()


def test_search_of_a_recording_has_a_time_limit_by_its_size(tmp_path, monkeypatch):
    (path,) = split(tmp_path, survey_of(100), (0, 100))
    monkeypatch.setattr(survey_detection, "MAX_SEARCH_S", -60.0)
    monkeypatch.setattr(survey_detection, "MAX_SEARCH_S_PER_MB", 0.0)
    with pytest.raises(SurveyFileError, match="search: got 'unfinished'"):
        detect_in_survey(path, "0" * 64, "uuv-1", HOLDING)


def test_number_of_contacts_of_a_recording_is_limited(tmp_path, monkeypatch):
    (path,) = split(tmp_path, survey_of(400, *(Box(row) for row in range(60, 380, 60))), (0, 400))
    monkeypatch.setattr(survey_detection, "MAX_CONTACTS", 2)
    assert detect_in_survey(path, "0" * 64, "uuv-1", AtdStubConfig()).contact_count == 2


def test_pings_that_claim_a_long_range_for_few_samples_are_not_searched(tmp_path):
    survey = survey_of(100, Box(50))
    far = [replace(p, channels=tuple(replace(c, slant_range_m=9999.0) for c in p.channels)) for p in survey.pings]
    write_xtf(replace(survey, pings=tuple(far)), tmp_path / "far.xtf")
    [end] = detect_in_survey(tmp_path / "far.xtf", "0" * 64, "uuv-1", HOLDING).ends.values()
    assert {ping.channels for ping in end.pings} == {()}


def test_pings_with_too_few_samples_for_their_range_are_counted_in_a_warning(tmp_path):
    path = make_xtf(small_survey(samples=20), tmp_path)  # 25 m of slant range
    result = detect_in_survey(path, "0" * 64, "uuv-1", AtdStubConfig())
    assert "5 pings have over 1 m of slant range for each sample: not searched" in result.warnings
    assert result.contact_count == 0
