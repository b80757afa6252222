"""The chain in containers: a compose project of its own, asked and disturbed by its users' means."""

import json
import os
import shutil
import subprocess
import time
from dataclasses import dataclass, field

import pytest

from builders.common import REPOSITORY
from sonarpost.extensions.simulation.demo.settings import PLATFORM_OF

PROFILES = ("sim", "uuv", "vessel", "shore")
ROUTERS = ("router-uuv", "router-vessel", "router-shore", "router-sim")
PUBLISHED = ("VESSEL_CONSOLE_PUBLISH", "SHORE_CONSOLE_PUBLISH", "SHORE_PUBLISH")
SERVICES = (*PLATFORM_OF, "console", "console-shore", *ROUTERS)
# Prints {file name: SHA-256} of the images under a folder, each in its latest version, and how many are complete.
# Earlier versions need not be ashore: a newer one may take their place on the way. An image's JSON is written last:
# where it is, the files are whole.
IMAGES = """
import hashlib, json, pathlib
folder = pathlib.Path("/var/lib/sonarpost/images")
latest = {}
for card in folder.rglob("*_v*.json"):
    name, _, version = card.stem.rpartition("_v")
    if card.with_suffix(".tiff").exists() and int(version) > latest.get(name, (0, None))[0]:
        latest[name] = (int(version), card)
cards = {card.with_suffix(".tiff"): card for _, card in latest.values()}
found = {tiff.name: hashlib.sha256(tiff.read_bytes()).hexdigest() for tiff in cards}
complete = sum(json.loads(card.read_text())["complete"] for card in cards.values())
print(json.dumps({"images": found, "complete": complete}))
"""
# Kills the service as a fault would, so that the engine's restart policy acts; `docker kill` counts as a person's wish.
KILL = """
import os, pathlib, signal
for entry in pathlib.Path("/proc").iterdir():
    if entry.name.isdigit() and int(entry.name) not in (1, os.getpid()):
        if (entry / "stat").read_text().rpartition(")")[2].split()[1] == "1":
            os.kill(int(entry.name), signal.SIGKILL)
"""

# Logs in and prints how many contacts the console shows, and the status of a request without a session.
LOG_IN = """
import json, urllib.error, urllib.request
site = "http://127.0.0.1:8470"
body = json.dumps({{"user": "anna", "password": {password!r}}}).encode()
asked = urllib.request.Request(site + "/api/login", body, {{"Content-Type": "application/json"}})
with urllib.request.urlopen(asked) as answer:
    cookie = answer.headers["Set-Cookie"].split(";")[0]
asked = urllib.request.Request(site + "/api/contacts", headers={{"Cookie": cookie}})
with urllib.request.urlopen(asked) as answer:
    total = json.load(answer)["total"]
try:
    urllib.request.urlopen(site + "/api/contacts")
except urllib.error.HTTPError as error:
    print(json.dumps([total, error.code]))
"""


def compose_commands():
    """Return Compose v2 and v1 where they are installed."""
    found = [[path] for name in ("docker", "docker-compose") if (path := shutil.which(name))]
    commands = [[*command, "compose"] if command[0].endswith("docker") else command for command in found]
    commands = [
        c for c in commands if subprocess.run([*c, "version"], capture_output=True, check=False).returncode == 0
    ]
    if not commands:
        pytest.skip("neither `docker compose` nor docker-compose is installed")
    return commands


@dataclass
class Project:
    """A compose project; its containers are looked up by their service."""

    name: str
    environment: dict[str, str]
    files: list[str] = field(default_factory=lambda: ["docker-compose.yml", "tests/system/compose/small-volume.yml"])

    def compose(self, *arguments, check=True):
        """Run a compose command; its output."""
        command = [*compose_commands()[0], "-p", self.name]
        command += [option for file in self.files for option in ("-f", file)]
        command += [option for profile in PROFILES for option in ("--profile", profile)]
        done = subprocess.run(
            [*command, *arguments],
            cwd=REPOSITORY,
            env={**os.environ, **self.environment},
            capture_output=True,
            text=True,
            check=False,
        )
        assert not check or done.returncode == 0, f"{arguments}: {done.stdout}\n{done.stderr}"
        return done.stdout

    def container(self, service):
        labels = (f"project={self.name}", f"service={service}", "oneoff=False")
        filters = [option for label in labels for option in ("--filter", f"label=com.docker.compose.{label}")]
        found = docker("ps", "-aq", *filters).split()
        assert len(found) == 1, (service, found)
        return found[0]

    def state(self, service):
        [state] = json.loads(docker("inspect", self.container(service)))
        assert isinstance(state, dict)
        return state

    def health(self, service):
        """Return starting, healthy or unhealthy, and what the check said last."""
        health = self.state(service)["State"]["Health"]
        log = health["Log"]
        return f"{health['Status']}: {log[-1]['Output'].strip() if log else ''}"

    def inside(self, service, script, *, check=True):
        """Run a Python script in a service's container; its output."""
        return docker("exec", self.container(service), "python", "-c", script, check=check)

    def addresses(self, service):
        """Return a service's address in each network."""
        networks = self.state(service)["NetworkSettings"]["Networks"]
        return {name.removeprefix(f"{self.name}_"): n["IPAddress"] for name, n in networks.items()}

    def survey(self, number):
        """Put simulated surveys into the vehicle's folder, up to this number."""
        self.environment["SIM_SURVEYS"] = str(number)
        self.compose("run", "--rm", "-e", "SURVEY_INTERVAL_S=0", "survey_source", "sonarpost-surveys", str(number))

    def contacts(self):
        """Return how many contacts the vehicle has handed on, told by its store."""
        script = (
            "import sqlite3; db = sqlite3.connect('file:/var/lib/sonarpost/state/compressor.db?mode=ro', uri=True); "
            "print(db.execute('SELECT COALESCE(SUM(highest), 0) FROM received_window').fetchone()[0])"
        )
        return int(self.inside("compressor", script))

    def surveys_done(self):
        """Return how many survey files the vehicle has dealt with."""
        script = (
            "import sqlite3; db = sqlite3.connect('file:/var/lib/sonarpost/state/atd_stub.db?mode=ro', uri=True); "
            "count = lambda kind: db.execute('SELECT COUNT(*) FROM state WHERE name LIKE ?', (kind,)).fetchone()[0]; "
            "print(count('file:%'), count('pending/%') + db.execute('SELECT COUNT(*) FROM outbox').fetchone()[0])"
        )
        files, owed = self.inside("atd_stub", script).split()
        return int(files) if owed == "0" else 0

    def images(self, service):
        """Return a service's images (name to SHA-256) and how many of them are complete."""
        return read_images(self.inside(service, IMAGES))

    def kept(self, volume):
        """Return the images in a volume, whether or not a service has it."""
        mount = f"{self.name}_{volume}:/var/lib/sonarpost/images:ro"
        return read_images(
            docker("run", "--rm", "-v", mount, self.environment["SONARPOST_IMAGE"], "python", "-c", IMAGES)
        )

    def wait_until_healthy(self, services=SERVICES):
        """Wait until every service says that it is well."""
        for service in services:
            until(lambda s=service: self.health(s).startswith("healthy"), f"{service} healthy")


def until(condition, what, within_s=400.0):
    """Wait until `condition()` holds; a look costs a process in a container, so there is one a second."""
    deadline = time.monotonic() + within_s
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"{what} did not come true within {within_s} s")
        time.sleep(1.0)  # noqa: TID251 polls


def read_images(text):
    """Return what the script IMAGES printed."""
    found = json.loads(text)
    return found["images"], found["complete"]


def docker(*arguments, check=True):
    """Run a docker command; its output."""
    done = subprocess.run(["docker", *arguments], capture_output=True, text=True, check=False)
    assert not check or done.returncode == 0, f"{arguments}: {done.stdout}\n{done.stderr}"
    # A container's standard error is its log.
    return done.stdout + done.stderr if arguments[0] == "logs" else done.stdout


@pytest.fixture(scope="session")
def project():
    """The running chain, removed with its volumes after the last test, also after failures."""
    name = os.environ.get("SONARPOST_COMPOSE_PROJECT")
    if name is None:
        pytest.skip("starts containers: `make test-compose` runs it")
    chain = Project(
        name,
        {
            "SONARPOST_IMAGE": os.environ["SONARPOST_IMAGE"],
            "SIM_SURVEYS": "1",
            "SIM_TIME_SCALE": "60.0",
            "HEALTH_INTERVAL_S": "1.0",
            "JOIN_TIMEOUT_S": "0.0",
            "HEALTH_CHECK_INTERVAL": "3s",
            # Free ports of this host: other tests and demos use 8470.
            **dict.fromkeys(PUBLISHED, "127.0.0.1:"),
        },
    )
    try:
        chain.compose("up", "-d", "--no-build")
        yield chain
    finally:
        logs = chain.compose("logs", "--no-color", "--tail", "30", check=False)
        chain.compose("down", "-v", "--remove-orphans", "-t", "3", check=False)
        print(logs)
