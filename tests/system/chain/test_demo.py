"""The demo as a user runs it: its last line, its files, its exit status, and the end of all its processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from builders.chain import snippet
from builders.common import eventually
from PIL import Image

from sonarpost.sonar.image_files import write_png, write_tiff

pytestmark = pytest.mark.chain

FIELDS = {
    "contacts": int,
    "frames_sent": int,
    "frames_lost": int,
    "images_vessel": int,
    "images_shore": int,
    "images_complete": int,
    "sha256_match": bool,
    "acoustic_s": float,
    "elapsed_s": float,
    "out": str,
}


def demo(out: Path, *options: str) -> list[str]:
    return [sys.executable, "-m", "sonarpost.cli.main", "demo", "--out", str(out), *options]


def run_demo(out: Path, *options: str, status: int = 0) -> dict[str, object]:
    done = subprocess.run(demo(out, *options, "--json"), capture_output=True, text=True, timeout=150, check=False)
    assert done.returncode == status, done.stderr[-2000:]
    result = json.loads(done.stdout.splitlines()[-1])
    assert {name: type(value) for name, value in result.items()} == FIELDS
    return result


def processes_of(folder: Path) -> list[int]:
    """Return the processes whose command line contains `folder`."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                command = (entry / "cmdline").read_bytes()
            except OSError:
                continue
            if str(folder).encode() in command:
                found.append(int(entry.name))
    return found


def test_demo_delivers_a_simulated_survey(tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run_demo(out, "--time-scale", "60")
    assert result["contacts"] == result["images_vessel"] == result["images_shore"] == result["images_complete"]
    assert isinstance(result["contacts"], int)
    assert result["contacts"] >= 6  # the simulated survey has six mine-like objects
    assert result["frames_lost"] == 0
    assert result["sha256_match"] is True
    with Image.open(out / "demo.png") as sheet:
        assert sheet.width > 500
        assert sheet.height > 500
    sidecars = [json.loads(p.read_text()) for p in (out / "shore" / "images" / "vessel-1").glob("*.json")]
    assert all(s["contact"]["lat_deg"] and s["contact"]["lon_deg"] for s in sidecars)
    assert processes_of(out) == []
    snippets = ("--images", str(snippet_folder(tmp_path)))
    again = run_demo(out, "--paper", *snippets, "--time-scale", "60", "--rate", "4", "--loss", "0.5", "--seed", "5")
    assert isinstance(again["frames_lost"], int)
    assert again["frames_lost"] > 0
    assert again["images_shore"] == again["images_vessel"]


@pytest.mark.realdata
def test_real_survey_arrives_with_its_contacts_and_positions(tmp_path: Path, data_dir: Path) -> None:
    out = tmp_path / "out"
    result = run_demo(out, "--survey", str(data_dir / "surveys" / "scotsman-iver2.xtf"), "--time-scale", "60")
    assert isinstance(result["contacts"], int)
    assert result["contacts"] >= 4
    assert result["images_complete"] == result["contacts"]
    assert result["sha256_match"] is True
    for path in (out / "shore" / "images" / "vessel-1").glob("*.json"):
        contact = json.loads(path.read_text())["contact"]
        # The bounds of the recorded track.
        assert contact["lat_deg"] == pytest.approx(48.4457, abs=0.001)
        assert contact["lon_deg"] == pytest.approx(-68.8283, abs=0.002)


def snippet_folder(parent: Path) -> Path:
    folder = parent / "snippets"
    folder.mkdir()
    write_png(folder / "a.png", snippet(1))
    write_tiff(folder / "b.tiff", snippet(2).astype("uint16") * 200)
    (folder / "notes.txt").write_text("not an image")
    return folder


def test_folder_of_snippets_is_sent(tmp_path: Path) -> None:
    result = run_demo(tmp_path / "out", "--images", str(snippet_folder(tmp_path)), "--time-scale", "60")
    assert result["contacts"] == result["images_complete"] == 2


@pytest.mark.parametrize(
    ("loss", "broken", "message"),
    [
        ("0", {"DECOMPRESSOR__IMAGE_CONSUMERS": "[]"}, "FAILED: 2 images missing at the shore site"),
        (
            "0.5",
            {"UUV_MODEM__FEEDBACK": "never", "UUV_MODEM__EXPECTED_LOSS": "0.0", "OP_MODEM__FEEDBACK": "false"},
            "incomplete at the shore site",
        ),
    ],
)
def test_demo_fails_when_an_image_is_missing_or_incomplete(
    loss: str, broken: dict[str, str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in broken.items():
        monkeypatch.setenv(f"SONARPOST_{name}", value)
    options = ("--images", str(snippet_folder(tmp_path)), "--time-scale", "60", "--loss", loss)
    done = subprocess.run(demo(tmp_path / "out", *options), capture_output=True, text=True, timeout=150, check=False)
    assert done.returncode == 1
    assert message in " ".join(done.stderr.split())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_is_left_when_the_demo_is_ended(tmp_path: Path, number: signal.Signals) -> None:
    out = tmp_path / "out"
    process = subprocess.Popen(demo(out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    eventually(lambda: len(processes_of(out / "config")) == 8, 30, "all services started")
    time.sleep(1.0)
    process.send_signal(number)
    status = process.wait(timeout=15)
    assert status == (130 if number == signal.SIGINT else -signal.SIGKILL)
    eventually(lambda: processes_of(out) == [], 10, "every process ended")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--survey", "/nowhere/a.xtf"), "/nowhere/a.xtf: got 'no such file or folder'"),
        (("--images", "/"), "expected files named *.tif"),
        (("--rate", "9"), "invalid choice"),
        (("--loss", "1.5"), "expected 0 to 1"),
    ],
)
def test_invalid_options_are_refused_in_one_line(tmp_path: Path, options: tuple[str, ...], message: str) -> None:
    done = subprocess.run(demo(tmp_path / "out", *options), capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_folder_with_other_files_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    done = subprocess.run(demo(tmp_path), capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 2
    assert "a folder that is new, empty or of an earlier demo" in done.stderr
    assert (tmp_path / "precious.txt").read_text() == "mine"


def test_unreadable_survey_is_named_with_the_reason(tmp_path: Path) -> None:
    survey = tmp_path / "empty.xtf"
    survey.touch()
    options = ("--survey", str(survey), "--json")
    done = subprocess.run(demo(tmp_path / "out", *options), capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert "refused: " in done.stderr
    assert "empty.xtf" in done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["contacts"] == 0
