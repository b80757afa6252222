"""The demo as a user runs it: its last line, its files, its exit status, and the end of all its processes."""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from builders.chain import snippet
from builders.common import eventually
from PIL import Image

from sonarpost.cli.main import main
from sonarpost.extensions.simulation.demo.settings import UUV_ADDRESS
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf
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


def demo(out, *options):
    return [sys.executable, "-m", "sonarpost.cli.main", "demo", "--out", str(out), *options]


def run_command(out, *options):
    return subprocess.run(demo(out, *options), capture_output=True, text=True, check=False)


def evidence(out, done):
    """Return what a failed demo printed, which images were encoded of which contacts, and all warnings."""
    logs = [(path.stem, path.read_text(errors="replace").splitlines()) for path in sorted((out / "logs").glob("*.log"))]
    lines = [
        f"{name}: {line[:200]}"
        for name, log in logs
        for line in log
        if re.search("Contact detected|encoded|Z [WE]", line)
    ]
    return "\n".join([done.stderr[-2000:], *lines[-40:]])


def run_demo(out, *options):
    done = run_command(out, *options, "--json")
    assert done.returncode == 0, evidence(out, done)
    result = json.loads(done.stdout.splitlines()[-1])
    assert {name: type(value) for name, value in result.items()} == FIELDS
    return result


def processes_of(folder):
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


def reasons_of_loss(channel_log):
    """Return the outcomes of the vehicle's packets of which a frame was lost."""
    packets = [json.loads(line) for line in channel_log.read_text().splitlines()]
    return {
        packet["outcome"]
        for packet in packets
        if packet["event"] == "packet"
        and packet["source"] == UUV_ADDRESS
        and any(frame["fate"] == "lost" for frame in packet["frames"])
    }


def test_demo_delivers_a_simulated_survey(tmp_path):
    out = tmp_path / "out"
    result = run_demo(out, "--time-scale", "60")
    assert result["contacts"] == result["images_vessel"] == result["images_shore"] == result["images_complete"]
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
    assert again["frames_lost"] > 0
    assert again["images_shore"] == again["images_vessel"]


@pytest.mark.realdata
def test_real_survey_arrives_with_its_contacts_and_positions(tmp_path, data_dir):
    out = tmp_path / "out"
    result = run_demo(out, "--survey", str(data_dir / "surveys" / "scotsman-iver2.xtf"), "--time-scale", "60")
    assert result["contacts"] >= 4
    assert result["images_complete"] == result["contacts"]
    assert result["sha256_match"] is True
    for path in (out / "shore" / "images" / "vessel-1").glob("*.json"):
        contact = json.loads(path.read_text())["contact"]
        # The bounds of the recorded track.
        assert contact["lat_deg"] == pytest.approx(48.4457, abs=0.001)
        assert contact["lon_deg"] == pytest.approx(-68.8283, abs=0.002)


def snippet_folder(parent):
    folder = parent / "snippets"
    folder.mkdir()
    write_png(folder / "a.png", snippet(1))
    write_tiff(folder / "b.tiff", snippet(2).astype("uint16") * 200)
    (folder / "notes.txt").write_text("not an image")
    return folder


def own_image_folder(parent):
    folder = parent / "own"
    folder.mkdir()
    grey = Image.fromarray(snippet(3)).resize((900, 640))
    Image.merge("RGB", (grey, grey.point(lambda level: level // 2), grey)).save(folder / "phone.jpg")
    (folder / "phone.txt").write_text("lat_deg: 56.45\nlon_deg: -5.6\nlatitude: 3\n")
    write_png(folder / "plain.png", snippet(4))
    write_tiff(folder / "wide.tiff", snippet(2).astype("uint16") * 200)
    (folder / "phone.heic").write_text("not an image")
    return folder


def test_own_images_arrive_with_positions_and_every_change_is_named(tmp_path):
    out = tmp_path / "out"
    options = ("--images", str(own_image_folder(tmp_path)), "--time-scale", "60", "--fit", "resize", "--json")
    done = run_command(out, *options)
    assert done.returncode == 0, evidence(out, done)
    result = json.loads(done.stdout.splitlines()[-1])
    assert result["contacts"] == result["images_complete"] == 3
    for text in (
        "phone.heic: not used: not a JPEG, PNG or TIFF image",
        "phone.jpg: colour converted to grey",
        "phone.jpg: 900 × 640 px resized to 512 × 364 px",
        "phone.jpg: line 3 ignored: 'latitude' is not a field of a contact",
        "1 of 3 images have a side-car",
    ):
        assert text in done.stderr
    sidecars = [json.loads(path.read_text()) for path in (out / "shore" / "images" / "vessel-1").glob("*.json")]
    positions = {(s["contact"]["lat_deg"], s["contact"]["lon_deg"]) for s in sidecars}
    ((lat_deg, lon_deg),) = positions - {(None, None)}
    assert len(positions) == 2
    assert (lat_deg, lon_deg) == pytest.approx((56.45, -5.6), abs=1e-5)


def test_unusable_images_are_refused_before_the_start(tmp_path, capsys):
    own = own_image_folder(tmp_path)
    for name in ("plain.png", "wide.tiff"):
        (own / name).unlink()

    def refused():
        assert main(["demo", "--out", str(tmp_path / "out"), "--images", str(own)]) == 2
        return capsys.readouterr().err

    assert "phone.jpg: size: got '900 × 640 px', expected 16 to 512 px a side; --fit crop or --fit resize" in refused()
    Image.fromarray(snippet(3)).save(own / "phone.jpg")
    (own / "phone.txt").write_text("lat_deg: 56.45\nlon_deg: west\n")
    assert "phone.txt line 2: lon_deg: got 'west', expected a number" in refused()
    for file in own.iterdir():
        file.unlink()
    assert "own: images: got 0, expected" in refused()
    assert not (tmp_path / "out").exists()


def test_demo_fails_when_an_image_is_missing(tmp_path, monkeypatch):
    monkeypatch.setenv("SONARPOST_DECOMPRESSOR__IMAGE_CONSUMERS", "[]")
    done = run_command(tmp_path / "out", "--images", str(snippet_folder(tmp_path)), "--time-scale", "60")
    assert done.returncode == 1
    assert "FAILED: 2 images missing at the shore site" in " ".join(done.stderr.split()), done.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_no_process_is_left_when_the_demo_is_ended(tmp_path, number):
    out = tmp_path / "out"
    process = subprocess.Popen(demo(out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    eventually(lambda: len(processes_of(out / "config")) == 8, what="all services started")
    process.send_signal(number)
    status = process.wait(timeout=120)
    assert status == (130 if number == signal.SIGINT else -signal.SIGKILL)
    eventually(lambda: processes_of(out) == [], what="every process ended")


def test_surveys_without_contacts_end_with_the_reasons(tmp_path):
    surveys = tmp_path / "surveys"
    surveys.mkdir()
    (surveys / "empty.xtf").touch()
    spec = SurveySpec(seed=1, seabed=SeabedKind.ROCK, pings=300, samples=400, targets=2, clutter=4)
    write_xtf(simulate_survey(spec).survey, surveys / "a line.xtf")
    done = run_command(tmp_path / "out", "--survey", str(surveys), "--threshold", "1.9", "--json")
    assert done.returncode == 1
    assert re.search(r"refused: \S*empty\.xtf", done.stderr)
    assert re.search(r"a line\.xtf\W+0 contacts above 1\.9; \d+ above 1\.0, .*[1-9]\d* above 0\.1", done.stderr)
    assert "no contacts to send: run the demo again with a lower --threshold" in done.stderr
    assert "contact sheet" not in done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["contacts"] == 0
