"""atd_stub: recordings of several files are processed, deduplicated, quarantined and removed as one."""

import shutil

import pytest
from builders.common import eventually
from builders.survey_oracle import tiny_survey
from builders.surveys import make_humminbird, make_waterfall

from sonarpost.services.atd_stub import service as atd_stub
from sonarpost.sonar.readers import recording_parts

MAKERS = {"humminbird": make_humminbird, "waterfall": make_waterfall}


@pytest.fixture(params=sorted(MAKERS))
def recording(request, tmp_path):
    """Return the files of a recording outside the input folder, the one that names it first."""
    folder = tmp_path / "made"
    folder.mkdir()
    return recording_parts(MAKERS[request.param](tiny_survey(40, 400), folder))


def deposit(part, recording, incoming):
    """Put a file into the input folder, complete when it appears."""
    target = incoming / part.relative_to(recording[0].parent)
    target.parent.mkdir(exist_ok=True)
    hidden = target.with_name(f".{target.name}")
    shutil.copyfile(part, hidden)
    hidden.rename(target)
    return target


def test_recording_is_processed_when_all_files_exist_and_once_under_any_name(
    start_service, recording, incoming, counter, gauge, lines
):
    """The other files may arrive first."""
    service = start_service()
    parts = list(reversed(recording))
    for part in parts[:-1]:
        deposit(part, recording, incoming)
    deposit(parts[-1], recording, incoming)
    eventually(lambda: counter(service, "files_processed") == 1)
    assert counter(service, "files_quarantined") == 0
    eventually(lambda: gauge(service, "files_waiting") == 0)  # counted after the commit
    again = incoming / recording[0].name.replace("line", "again", 1)
    shutil.copyfile(recording[0], again)
    if len(recording) == 3:  # the DAT file names its folder, which is not there yet
        eventually(lambda: lines("Recording waits for missing files"))
        assert gauge(service, "files_waiting") == 1
        shutil.copytree(incoming / "line", incoming / "again")
    eventually(lambda: lines("File already processed"))
    assert (counter(service, "files_processed"), counter(service, "files_quarantined")) == (1, 0)


def test_changed_part_makes_another_recording(start_service, recording, incoming, counter):
    for part in recording:
        deposit(part, recording, incoming)
    service = start_service()
    eventually(lambda: counter(service, "files_processed") == 1)
    damaged = incoming / recording[-1].relative_to(recording[0].parent)
    damaged.write_bytes(b"not a file of a recording")
    # Of a Humminbird recording the other side is read.
    eventually(lambda: counter(service, "files_quarantined") + counter(service, "files_processed") == 2)


def test_all_files_of_a_bad_recording_are_moved(start_service, recording, incoming, counter):
    for part in recording[1:]:
        part.write_bytes(b"not a file of a recording")
    service = start_service()
    for number in range(2):  # the second one differs, and has the same name
        recording[-2].write_bytes(recording[-2].read_bytes() + bytes([number]))
        targets = [deposit(part, recording, incoming) for part in reversed(recording)]
        eventually(lambda number=number: counter(service, "files_quarantined") == number + 1)
        eventually(lambda targets=targets: not any(target.exists() for target in targets))
    aside = incoming / "quarantine"
    names = [str(part.relative_to(recording[0].parent)) for part in recording]
    assert [path.name for path in incoming.iterdir()] == ["quarantine"]
    (other,) = (path for path in aside.iterdir() if path.is_dir() and path.name != "line")
    for folder in (aside, other):
        assert all((folder / name).is_file() for name in names)
        assert (folder / f"{names[0]}.reason.txt").read_text()


def test_done_marker_completes_a_recording_with_one_side(start_service, incoming, counter, lines):
    path = make_humminbird(tiny_survey(40, 400), incoming)
    (incoming / "line" / "B003.SON").unlink()
    service = start_service()
    eventually(lambda: lines("Recording waits for missing files"))
    assert counter(service, "files_processed") == 0
    (incoming / f"{path.name}.done").touch()
    eventually(lambda: counter(service, "files_processed") == 1)


def test_files_outside_the_folder_and_of_other_recordings_stay(start_service, incoming, tmp_path, counter):
    """A description may name any file; only files in the folder that no other recording uses are moved."""
    make_waterfall(tiny_survey(40, 400), incoming)
    outside = tmp_path / "outside.csv"
    outside.write_text("not the table of a recording")
    bad = (incoming / "line.waterfall.toml").read_text().replace("line.csv", "../outside.csv")
    (incoming / "bad.waterfall.toml").write_text(bad)
    service = start_service()
    eventually(lambda: counter(service, "files_quarantined") == 1 and counter(service, "files_processed") == 1)
    eventually((incoming / "quarantine" / "bad.waterfall.toml").is_file)
    assert outside.is_file()
    assert all(part.is_file() for part in recording_parts(incoming / "line.waterfall.toml"))


def test_retention_removes_all_files(start_service, recording, incoming, monkeypatch):
    monkeypatch.setattr(atd_stub, "INTERVAL_S", 0.0)
    for part in recording:
        deposit(part, recording, incoming)
    start_service(max_bytes=0)
    eventually(lambda: not list(incoming.iterdir()), what="removal")
