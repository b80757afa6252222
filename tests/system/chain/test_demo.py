"""The demo as a user runs it: its last line, its files, its exit status, and the end of all its processes."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from builders.chain import snippet
from builders.common import eventually
from PIL import Image

from sonarpost.cli.demo.settings import UUV_ADDRESS
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.image_files import write_png, write_tiff
from sonarpost.sonar.xtf_writer import write_xtf

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
    done = subprocess.run(demo(out, *options, "--json"), capture_output=True, text=True, timeout=400, check=False)
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


def reasons_of_loss(channel_log: Path) -> set[str]:
    """Return the outcomes of the vehicle's packets of which a frame was lost."""
    packets = [json.loads(line) for line in channel_log.read_text().splitlines()]
    return {
        packet["outcome"]
        for packet in packets
        if packet["event"] == "packet"
        and packet["source"] == UUV_ADDRESS
        and any(frame["fate"] == "lost" for frame in packet["frames"])
    }


def test_demo_delivers_a_simulated_survey(tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = run_demo(out, "--time-scale", "60")
    assert result["contacts"] == result["images_vessel"] == result["images_shore"] == result["images_complete"]
    assert isinstance(result["contacts"], int)
    assert result["contacts"] >= 6  # the simulated survey has six mine-like objects
    # The channel loses nothing at random. On a slow computer the vessel may transmit while a packet arrives.
    assert reasons_of_loss(out / "water" / "channel.jsonl") <= {"receiver transmitting"}
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


def own_image_folder(parent: Path) -> Path:
    folder = parent / "own"
    folder.mkdir()
    grey = Image.fromarray(snippet(3)).resize((900, 640))
    Image.merge("RGB", (grey, grey.point(lambda level: level // 2), grey)).save(folder / "phone.jpg")
    (folder / "phone.txt").write_text("lat_deg: 56.45\nlon_deg: -5.6\nlatitude: 3\n")
    write_png(folder / "plain.png", snippet(4))
    (folder / "phone.heic").write_text("not an image")
    return folder


def test_own_images_arrive_with_positions_and_every_change_is_named(tmp_path: Path) -> None:
    out = tmp_path / "out"
    options = ("--images", str(own_image_folder(tmp_path)), "--time-scale", "60", "--fit", "resize", "--json")
    done = subprocess.run(demo(out, *options), capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout.splitlines()[-1])["images_complete"] == 2
    for text in (
        "phone.heic: not used: not a JPEG, PNG or TIFF image",
        "phone.jpg: colour converted to grey",
        "phone.jpg: 900 × 640 px resized to 512 × 364 px",
        "phone.jpg: line 3 ignored: 'latitude' is not a field of a contact",
        "1 of 2 images have a side-car",
    ):
        assert text in done.stderr
    sidecars = [json.loads(path.read_text()) for path in (out / "shore" / "images" / "vessel-1").glob("*.json")]
    positions = {(s["contact"]["lat_deg"], s["contact"]["lon_deg"]) for s in sidecars}
    assert (None, None) in positions
    ((lat_deg, lon_deg),) = positions - {(None, None)}
    assert lat_deg == pytest.approx(56.45, abs=1e-5)
    assert lon_deg == pytest.approx(-5.6, abs=1e-5)


def test_unusable_images_are_refused_before_the_start(tmp_path: Path) -> None:
    own = own_image_folder(tmp_path)
    (own / "plain.png").unlink()

    def refused() -> str:
        options = demo(tmp_path / "out", "--images", str(own))
        done = subprocess.run(options, capture_output=True, text=True, timeout=400, check=False)
        assert done.returncode == 2
        return done.stderr

    assert "phone.jpg: size: got '900 × 640 px', expected 16 to 512 px a side; --fit crop or --fit resize" in refused()
    Image.fromarray(snippet(3)).save(own / "phone.jpg")
    (own / "phone.txt").write_text("lat_deg: 56.45\nlon_deg: west\n")
    assert "phone.txt line 2: lon_deg: got 'west', expected a number" in refused()
    assert not (tmp_path / "out").exists()


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
    done = subprocess.run(demo(tmp_path / "out", *options), capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 1
    assert message in " ".join(done.stderr.split())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_is_left_when_the_demo_is_ended(tmp_path: Path, number: signal.Signals) -> None:
    out = tmp_path / "out"
    process = subprocess.Popen(demo(out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    eventually(lambda: len(processes_of(out / "config")) == 8, 120, "all services started")
    time.sleep(1.0)
    process.send_signal(number)
    status = process.wait(timeout=15)
    assert status == (130 if number == signal.SIGINT else -signal.SIGKILL)
    eventually(lambda: processes_of(out) == [], 10, "every process ended")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--survey", "/nowhere/a.xtf"), "/nowhere/a.xtf: got 'no such file or folder'"),
        (("--images", "/"), "/: images: got 0, expected"),
        (("--rate", "9"), "--rate: got 9, expected one of [0, 1, 2, 3, 4, 5, 6]"),
        (("--loss", "1.5"), "expected 0 to 1"),
    ],
)
def test_invalid_options_are_refused_in_one_line(tmp_path: Path, options: tuple[str, ...], message: str) -> None:
    done = subprocess.run(demo(tmp_path / "out", *options), capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_folder_with_other_files_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    done = subprocess.run(demo(tmp_path), capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 2
    assert "a folder that is new, empty or of an earlier demo" in done.stderr
    assert (tmp_path / "precious.txt").read_text() == "mine"


def test_unreadable_survey_is_named_with_the_reason(tmp_path: Path) -> None:
    (tmp_path / "surveys").mkdir()
    (tmp_path / "surveys" / "empty.xtf").touch()
    options = ("--survey", str(tmp_path / "surveys"), "--json")
    done = subprocess.run(demo(tmp_path / "out", *options), capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 1
    assert "refused: " in done.stderr
    assert "empty.xtf" in done.stderr
    assert "no contacts to send" in done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["contacts"] == 0


def test_survey_without_contacts_ends_with_the_counts_at_lower_thresholds(tmp_path: Path) -> None:
    survey = tmp_path / "a line.xtf"
    spec = SurveySpec(seed=1, seabed=SeabedKind.ROCK, pings=300, samples=400, targets=2, clutter=4)
    write_xtf(simulate_survey(spec).survey, survey)
    options = ("--survey", str(survey), "--threshold", "1.9")
    done = subprocess.run(demo(tmp_path / "out", *options), capture_output=True, text=True, timeout=400, check=False)
    assert done.returncode == 1
    assert re.search(r"a line\.xtf\W+0 contacts above 1\.9; \d+ above 1\.0, .*[1-9]\d* above 0\.1", done.stderr)
    assert "no contacts to send: run the demo again with a lower --threshold" in done.stderr
    assert "contact sheet" not in done.stderr


def test_survey_in_metres_arrives_with_positions(tmp_path: Path) -> None:
    simulated = simulate_survey(SurveySpec(seed=1, pings=300, samples=512, targets=2, clutter=0))
    write_xtf(simulated.survey, tmp_path / "line.xtf", projected_crs="EPSG:32630")
    (tmp_path / "options.toml").write_text('projected_crs = "EPSG:32619"\n[errors]\nposition_m = 30.0\n')
    options = ("--survey", str(tmp_path / "line.xtf"), "--time-scale", "60", "--crs", "EPSG:32630")
    result = run_demo(tmp_path / "out", *options, "--options", str(tmp_path / "options.toml"))
    assert isinstance(result["contacts"], int)
    assert result["contacts"] >= 1
    first = simulated.survey.pings[0]
    contacts = [json.loads(p.read_text())["contact"] for p in (tmp_path / "out" / "shore").rglob("*.json")]
    assert len(contacts) >= result["contacts"]
    for contact in contacts:
        assert (contact["lat_deg"], contact["lon_deg"]) == pytest.approx((first.lat_deg, first.lon_deg), abs=0.002)
