"""Every command that the demo prints at its end works when it is pasted into a terminal in the same folder."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.request
from contextlib import ExitStack, contextmanager

import pytest
from builders.chain import snippet
from builders.common import LONG_WAIT_S, REPOSITORY, eventually

from sonarpost.extensions.simulation.demo.settings import reserved_ports
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf
from sonarpost.sonar.image_files import write_png

pytestmark = pytest.mark.chain

DEMO = [sys.executable, "-m", "sonarpost.cli.main", "demo", "--time-scale", "60"]
# Another terminal: without the virtual environment, and with the size of a small one.
TERMINAL = {name: value for name, value in os.environ.items() if name != "VIRTUAL_ENV"} | {
    "PATH": "/usr/bin:/bin",
    "COLUMNS": "80",
}


def run_demo(folder, *options):
    """Run a demo to its end; return what it prints."""
    command = [*DEMO, *options]
    done = subprocess.run(command, cwd=folder, env=TERMINAL, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.fixture
def folder(tmp_path):
    """A folder with the examples, as in a clone."""
    shutil.copytree(REPOSITORY / "examples", tmp_path / "examples", ignore=shutil.ignore_patterns("rust"))
    return tmp_path


def printed_commands(text):
    """Return the commands after `Next`, whose purpose is on the next line."""
    return re.findall(r"^  (\S.*)\n      \S", text.partition("\nNext")[2], re.MULTILINE)


@contextmanager
def pasted(command, folder, errors):
    """Run a command until the end of the block, and end it as Ctrl-C does."""
    process = subprocess.Popen(
        ["bash", "-c", f"exec {command}"], cwd=folder, env=TERMINAL, stdout=subprocess.PIPE, stderr=errors, text=True
    )
    with process:
        try:
            yield process
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(timeout=120)


def list_contacts(command, folder):
    done = subprocess.run(
        ["bash", "-c", command], cwd=folder, env=TERMINAL, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == "sonarpost c2: folder demo-out/shore/images\n"
    return done.stdout


def test_survey_in_metres_arrives_with_positions_and_commands_work_after_the_end(folder):
    simulated = simulate_survey(SurveySpec(seed=1, pings=300, samples=512, targets=2, clutter=0))
    write_xtf(simulated.survey, folder / "line.xtf", projected_crs="EPSG:32630")
    (folder / "options.toml").write_text('projected_crs = "EPSG:32619"\n[errors]\nposition_m = 30.0\n')
    text = run_demo(folder, "--survey", "line.xtf", "--crs", "EPSG:32630", "--options", "options.toml")
    # No line is wrapped at 80 columns, and the printed folders hold the images.
    for path in re.findall(r"^images at the .*: (\S+)$", text, re.MULTILINE):
        assert list((folder / path).glob("**/*.tiff")), path
    count = int(re.findall(r"^(\d+) contacts$", text, re.MULTILINE)[0])
    assert count >= 1
    first = simulated.survey.pings[0]
    contacts = [json.loads(p.read_text())["contact"] for p in (folder / "demo-out" / "shore").rglob("*.json")]
    assert len(contacts) >= count
    for contact in contacts:
        assert (contact["lat_deg"], contact["lon_deg"]) == pytest.approx((first.lat_deg, first.lon_deg), abs=0.002)
    ls, view, subscriber = printed_commands(text)
    assert list_contacts(ls, folder).endswith(f"{count} images\n")
    with (folder / "errors.txt").open("w+") as errors:
        with pasted(view, folder, errors) as page:
            address = page.stdout.readline().split()[0]
            assert page.stdout.readline().startswith("log-in link of watch")
            assert page.stdout.readline().startswith(f"{count} contacts in demo-out/shore/images, read only")
            with urllib.request.urlopen(address, timeout=120) as reply:
                assert b"<title>" in reply.read()
        assert page.returncode == 0
        with pasted(subscriber, folder, errors):
            endpoint = subscriber.split()[-2]
            eventually(lambda: f"waiting for {endpoint}" in (folder / "errors.txt").read_text(), what="subscriber")
            port = int(endpoint.rpartition(":")[2])
            with ExitStack() as stack:
                # The router of another demo, which may have this port by now, serves as well.
                if stack.enter_context(reserved_ports(port)) == (port,):
                    router = [sys.executable, "-m", "sonarpost.bus.router", "--listen", endpoint]
                    stack.callback(stack.enter_context(subprocess.Popen(router, stderr=subprocess.DEVNULL)).terminate)
                eventually(lambda: "subscribed" in (folder / "errors.txt").read_text(), what="subscription")
    assert "Traceback" not in (folder / "errors.txt").read_text()


def test_commands_work_while_the_chain_is_kept_running(folder):
    write_xtf(simulate_survey(SurveySpec(seed=1, pings=400, targets=2, clutter=1)).survey, folder / "line.xtf")
    text = folder / "demo.txt"
    with text.open("w") as errors:
        demo = subprocess.Popen([*DEMO, "--survey", "line.xtf", "--keep"], cwd=folder, env=TERMINAL, stderr=errors)
    try:
        eventually(lambda: "send another survey" in text.read_text(), LONG_WAIT_S, "the end of the demo")
        ls, _, subscriber, simulate = printed_commands(text.read_text())
        listed = list_contacts(ls, folder)
        with (folder / "errors.txt").open("w") as errors, pasted(subscriber, folder, errors) as process:
            eventually(lambda: "subscribed" in (folder / "errors.txt").read_text(), what="subscription")
            subprocess.run(["bash", "-c", simulate], cwd=folder, env=TERMINAL, check=True)
            assert process.stdout.readline().startswith("reconstructed_image uuv-1 ")
            # The example prints a record before it writes the image.
            eventually(lambda: any((folder / "demo-out").glob("uuv-1_*.pgm")), what="the image")
        assert len(list_contacts(ls, folder).splitlines()) > len(listed.splitlines())
    finally:
        demo.send_signal(signal.SIGINT)
        status = demo.wait(timeout=120)
    assert status == 0
    assert "Traceback" not in text.read_text()


def test_folder_and_programs_elsewhere_are_in_the_commands(tmp_path):
    """Without the examples, `c2 watch` is the subscriber; another output folder is named."""
    (tmp_path / "snippets").mkdir()
    write_png(tmp_path / "snippets" / "a.png", snippet(1))
    ls, view, watch = printed_commands(run_demo(tmp_path, "--out", "my results", "--images", "snippets"))
    assert ls.endswith("c2 ls --archive 'my results/shore/images'")
    assert view.endswith("console --view 'my results/shore/images'")
    assert re.search(r"c2 watch --router tcp/127\.0\.0\.1:\d+$", watch)
    listed = subprocess.run(["bash", "-c", ls], cwd=tmp_path, env=TERMINAL, capture_output=True, text=True, check=True)
    assert listed.stdout.endswith("1 images\n")
