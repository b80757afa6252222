"""The embedded router accepts zenohd's configuration files and options and reports errors in one line."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable

import pytest
import zenoh
from builders.common import REPOSITORY, eventually, free_port

from sonarpost import keys, wire
from sonarpost.bus import router
from sonarpost.bus.session import client_config
from sonarpost.errors import BadInputError, ConfigError
from sonarpost.messages import Health

Start = Callable[..., subprocess.Popen[str]]

CONFIG = """{
  // Comments, unquoted names and trailing commas: JSON5.
  mode: "router",
  listen: { endpoints: ["%s"] },
  connect: { endpoints: [] },
  scouting: { delay: 0, multicast: { enabled: false }, gossip: { enabled: false } },
  transport: { link: { tx: { lease: 3000 } } },
}
"""


@pytest.fixture
def start():
    """Starts router processes and stops them after the test."""
    started = []

    def start_one(*arguments):
        process = subprocess.Popen(
            [sys.executable, "-m", "sonarpost.bus.router", *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, "RUST_LOG": "error"},
        )
        started.append(process)
        return process

    yield start_one
    for process in started:
        if process.poll() is None:
            process.kill()
            process.wait()
        assert process.stdout is not None
        process.stdout.close()


def reach(endpoint):
    """Open a client session as soon as the router listens."""
    opened = []

    def try_once():
        try:
            opened.append(zenoh.open(client_config([endpoint])))
        except zenoh.ZError:
            return False
        return True

    eventually(try_once, what=f"a router at {endpoint}")
    return opened[0]


def write_config(tmp_path, text, name="router.json5"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.system
def test_linked_routers_with_files_forward_a_record(start, tmp_path):
    shore, vessel = (f"tcp/127.0.0.1:{free_port()}" for _ in range(2))
    processes = [
        start("--config", str(write_config(tmp_path, CONFIG % shore, "shore.json5"))),
        start("-c", str(write_config(tmp_path, CONFIG % vessel, "vessel.json5")), "-e", shore),
    ]
    with reach(shore) as ashore, reach(vessel) as aboard:
        received = threading.Event()
        subscriber = ashore.declare_subscriber("sonarpost/test", lambda _sample: received.set())
        publisher = aboard.declare_publisher("sonarpost/test")
        eventually(lambda: bool(publisher.matching_status.matching), what="the subscriber at the vessel's router")

        def forwarded():
            publisher.put(b"here")
            return received.wait(0.2)

        # Repeated: the vessel's router can report a subscriber before the link to it is complete.
        eventually(forwarded, what="the record at the shore router")
        subscriber.undeclare()
    for process in processes:
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=120) == 0
        output = process.communicate()[0]
        assert "Router started listen=tcp/127.0.0.1:" in output
        assert "Router stopped" in output


def test_command_line_endpoints_replace_those_of_the_file(tmp_path):
    path = write_config(tmp_path, CONFIG % "tcp/127.0.0.1:1")
    config = router.load(path, ["tcp/127.0.0.1:7001", "tcp/127.0.0.1:7002"], ["tcp/shore:7448"], [])
    assert json.loads(config.get_json("listen/endpoints")) == ["tcp/127.0.0.1:7001", "tcp/127.0.0.1:7002"]
    assert json.loads(config.get_json("connect/endpoints")) == ["tcp/shore:7448"]
    kept = router.load(path, [], [], [])
    assert json.loads(kept.get_json("listen/endpoints")) == ["tcp/127.0.0.1:1"]


def test_default_mode_of_a_file_is_router(tmp_path):
    config = router.load(write_config(tmp_path, "{}"), [], [], [])
    assert json.loads(config.get_json("mode")) == "router"


def test_settings_are_applied_last(tmp_path):
    path = write_config(tmp_path, CONFIG % "tcp/127.0.0.1:1")
    config = router.load(path, [], [], ["transport/link/tx/lease:1234", "metadata:{name:'a'}"])
    assert json.loads(config.get_json("transport/link/tx/lease")) == 1234
    assert json.loads(config.get_json("metadata")) == {"name": "a"}


def test_router_without_a_file_listens_on_loopback_only():
    config = router.load(None, [], [], [])
    assert json.loads(config.get_json("listen/endpoints")) == ["tcp/127.0.0.1:7447"]
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False


@pytest.mark.parametrize(
    ("text", "arguments", "words"),
    [
        (None, {}, ("router.json5", "No such file")),
        ("{mode: 'router', lisen: {}}", {}, ("router.json5", "lisen")),
        ("{mode: ", {}, ("router.json5", "JSON5")),
        ("{mode: 'client'}", {}, ("router.json5", "mode", "client")),
        ("{}", {"listen": ["nowhere"]}, ("--listen", "nowhere")),
        ("{}", {"connect": ["nowhere"]}, ("--connect", "nowhere")),
        ("{}", {"settings": ["lease"]}, ("--cfg", "lease", "KEY:VALUE")),
        ("{}", {"settings": ["no/such/key:1"]}, ("--cfg", "no/such/key")),
    ],
)
def test_error_names_the_invalid_setting(tmp_path, text, arguments, words):
    path = tmp_path / "router.json5"
    if text is not None:
        path.write_text(text)
    given = {"listen": [], "connect": [], "settings": [], **arguments}
    with pytest.raises(ConfigError) as caught:
        router.load(path, given["listen"], given["connect"], given["settings"])
    for word in words:
        assert word in str(caught.value)


def test_error_names_invalid_endpoints_without_a_file():
    with pytest.raises(ConfigError, match="Zenoh endpoints"):
        router.load(None, ["nowhere"], [], [])


def test_invalid_file_ends_the_process_with_one_line(start, tmp_path):
    process = start("--config", str(write_config(tmp_path, "{mode: 'router', lisen: {}}")))
    output = process.communicate(timeout=120)[0]
    assert process.returncode == router.EXIT_CANNOT_START
    [line] = output.splitlines()
    assert line.startswith("router: ")
    assert "lisen" in line


@pytest.mark.parametrize("path", sorted(REPOSITORY.glob("config/router-*.json5")), ids=lambda path: path.name)
def test_router_files_of_the_project_disable_discovery(path):
    config = router.load(path, [], [], [])
    assert json.loads(config.get_json("scouting/multicast/enabled")) is False
    assert json.loads(config.get_json("scouting/gossip/enabled")) is False
    assert json.loads(config.get_json("transport/shared_memory/enabled")) is False
    assert json.loads(config.get_json("transport/link/tx/lease")) == 3000
    wait = "transport/link/tx/queue/congestion_control/block/wait_before_close"
    assert json.loads(config.get_json(wait)) == 60_000_000
    # Without authentication, they listen on the loopback address only.
    endpoints = json.loads(config.get_json("listen/endpoints"))
    assert endpoints
    assert all(endpoint.startswith("tcp/127.0.0.1:") for endpoint in endpoints)


@pytest.mark.parametrize(
    ("metadata", "expected"),
    [
        ("null", (None, ())),
        ("'a name'", (None, ())),
        ("{name: 'a'}", (None, ())),
        ("{platform: 'vessel-1'}", ("vessel-1", ())),
        ("{platform: 'shore-1', sites: ['shore', 'north']}", ("shore-1", ("shore", "north"))),
    ],
)
def test_configuration_names_the_platform_and_its_sites(metadata, expected):
    assert router.platform_and_sites(zenoh.Config.from_json5(f"{{metadata: {metadata}}}")) == expected


def test_monitor_publishes_a_last_record_and_its_thread_ends():
    text = "{mode: 'peer', scouting: {multicast: {enabled: false}}, metadata: {platform: 'a'}}"
    config = zenoh.Config.from_json5(text)
    monitor = router.RouterMonitor(config)
    states = []
    with zenoh.open(config) as session:
        session.declare_subscriber(
            keys.health("a", "router"),
            lambda sample: states.append(wire.decode(Health, sample.payload.to_bytes(), "a").state),
        )
        monitor.start(session)
        monitor.close()
        assert "router-health" not in [thread.name for thread in threading.enumerate()]
        eventually(lambda: states == ["stopping"])


@pytest.mark.parametrize("metadata", ["{platform: 7}", "{platform: 'No Name'}", "{platform: 'a', sites: 'shore'}"])
def test_invalid_metadata_is_rejected(metadata):
    with pytest.raises(BadInputError):
        router.platform_and_sites(zenoh.Config.from_json5(f"{{metadata: {metadata}}}"))
