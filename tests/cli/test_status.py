"""`sonarpost status`: output on a terminal of 80 columns, for other programs, and a clean end."""

import fcntl
import json
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import threading

import pytest
import zenoh
from builders.common import WAIT_S, eventually, free_port
from builders.fleet import BROKEN, FLEET, Platforms, health, on_terminal, seen
from builders.record_samples import SAMPLES

from sonarpost import keys, wire
from sonarpost.bus.session import router_config
from sonarpost.cli.main import main
from sonarpost.cli.status import age_text, as_json, bytes_text, is_ok, plain_text, rows_of, vehicle_text
from sonarpost.messages import ReceivedStatus, VehicleRange, VehicleStatus
from sonarpost.monitoring.fleet import MAX_VEHICLES, FleetState, FleetTracker, FleetWatcher, VehicleState

RECEIVED_STATUS = SAMPLES["received-status"]
assert isinstance(RECEIVED_STATUS, ReceivedStatus)

LONG = ("--wait", str(WAIT_S))
NAMES = ("uuv_modem", "acoustic_channel", "op_modem", "decompressor")


def test_table_fits_eighty_columns():
    lines = on_terminal(FLEET)
    assert max(len(line) for line in lines) <= 80
    assert lines[0] == "tcp/127.0.0.1:7447: 5 of 7 services alive on 3 platforms, 2 records rejected"
    rows = {tuple(line.split()[:2]) if line[:1].strip() else ("", line.split()[0]): line for line in lines[3:10]}
    assert len(lines[3:10]) == len(rows) == 7
    assert re.fullmatch(r"uuv-1 +compressor +ok +1 s +0 +3 +- +12 GB", rows["uuv-1", "compressor"])
    assert re.fullmatch(r" +uuv_modem +degraded +3 s +- +- +no modem +-", rows["", "uuv_modem"])
    assert re.fullmatch(
        r"vessel-1 +decompressor +stale \(ok\) +3 min +0 +3 +- +12 GB", rows["vessel-1", "decompressor"]
    )
    assert re.fullmatch(r" +op_modem +ok +1 s +0 +3 +SNR 12 dB, loss 2 % +500 MB", rows["", "op_modem"])
    assert re.fullmatch(r" +relay +no data +- +- +- +- +-", rows["", "relay"])
    assert re.fullmatch(r"vessel-2 +relay +stopped +1 d +0 +3 +- +12 GB", rows["vessel-2", "relay"])
    assert re.fullmatch(r" +router +gone +4 s +0 +3 +- +12 GB", rows["", "router"])
    assert lines[-1] == "! uuv-1/uuv_modem: /dev/ttyUSB0: not open yet"


def test_long_names_are_folded():
    long = health("a" * 32, "b" * 40, detail="c" * 200)
    lines = on_terminal(FleetState((seen(long),), connected=True, rejected=0))
    assert max(len(line) for line in lines) <= 80
    assert [sum(line.count(c) for line in lines[:-3]) >= n for c, n in (("a", 32), ("b", 40))] == [True, True]
    assert "".join(lines).count("c") >= 200


def test_row_severity():
    def severity(state, *, connected=True):
        (row,) = rows_of(FleetState((state,), connected, 0), 15.0)
        return row.state, row.severity

    assert severity(seen(health(), 14.9)) == ("ok", "ok")
    assert severity(seen(health(), 15.1)) == ("stale (ok)", "stale")
    assert severity(seen(health(), 1.0, alive=None), connected=False) == ("ok?", "stale")
    assert severity(seen(health(state="degraded"))) == ("degraded", "error")
    assert severity(seen(None)) == ("no data", "stale")
    assert severity(seen(health(), alive=False)) == ("gone", "gone")


def test_fleet_is_ok_if_services_run_and_all_are_ok():
    def ok(*services, connected=True):
        state = FleetState(services, connected, 0)
        return is_ok(rows_of(state, 15.0), state)

    assert ok(seen(health()))
    assert not ok()
    assert not ok(seen(health()), connected=False)
    assert not ok(seen(health()), seen(BROKEN))


def test_plain_text_is_complete_and_has_no_control_characters():
    hostile = health("uuv-1", "uuv_modem", state="degraded", detail="\x1b[2J\r\nall is well")
    state = FleetState((seen(hostile), seen(health("a" * 32, "b" * 40))), connected=True, rejected=0)
    text = plain_text(state, rows_of(state, 15.0), "tcp/127.0.0.1:7447")
    assert text.replace("\n", "").isprintable()
    assert len(text.splitlines()) == 5
    assert ("a" * 32 + "  " + "b" * 40) in text
    assert "\x1b" not in "".join(on_terminal(state)[3:])


def test_age_and_bytes_as_text():
    ages = {None: "-", 0.0: "0 s", 59.9: "59 s", 60: "1 min", 7199: "1 h", 1e6: "11 d"}
    assert {age_s: age_text(age_s) for age_s in ages} == ages
    sizes = {None: "-", 0: "0 B", 999: "999 B", 3400: "3.4 kB", 1.2e10: "12 GB", 9e15: "9000 TB"}
    assert {size: bytes_text(size) for size in sizes} == sizes


@pytest.fixture
def platforms(client):
    platforms = Platforms(client)
    yield platforms
    platforms.close()


def test_once_as_text_and_as_json(router, platforms, capsys):
    platforms.run(health())
    assert main(["status", "--once", *LONG, "--router", router]) == 0
    out = capsys.readouterr().out
    assert out.splitlines()[1].split() == ["PLATFORM", "SERVICE", "STATE", "AGE", "IN", "OUT", "LINK", "DISK"]
    assert "\x1b" not in out
    platforms.run(BROKEN)
    assert main(["status", "--once", "--json", *LONG, "--router", router]) == 1
    printed = json.loads(capsys.readouterr().out)
    assert printed["connected"] is True
    services = {(s["platform"], s["service"]): s for s in printed["services"]}
    assert services["uuv-1", "uuv_modem"]["detail"] == BROKEN.detail
    assert services["vessel-1", "op_modem"]["gauges"] == health().gauges
    assert [s["well"] for s in services.values()] == [False, True]


def test_once_ends_without_a_router(capsys):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    assert main(["status", "--once", "--wait", "0.1", "--router", endpoint]) == 1
    assert capsys.readouterr().out.startswith(f"{endpoint}: router not reached yet")


def test_reason_of_an_unreached_router_is_shown_until_one_is_reached():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with FleetWatcher([endpoint], poll_s=0.05) as watcher:

        def shown():
            return plain_text(watcher.state(), (), endpoint).splitlines()[0]

        refused = f"(no connection: {endpoint}: Connection refused)"
        eventually(lambda: shown() == f"{endpoint}: router not reached yet {refused}")
        assert json.loads(as_json(watcher.state(), (), ""))["failure"] == refused[1:-1]
        for _ in range(2):
            hub = zenoh.open(router_config([endpoint]))
            eventually(lambda: watcher.state().connected)
            assert watcher.state().failure == ""
            hub.close()
            eventually(lambda: "Connection refused" in shown())


def test_router_from_the_configuration_file(tmp_path, router, platforms, capsys):
    platforms.run(health())
    config = tmp_path / "shore.toml"
    config.write_text(f'[platform]\nid = "shore-1"\nrouter = ["{router}"]\n')
    assert main(["status", "--once", *LONG, "--config", str(config)]) == 0
    assert capsys.readouterr().out.startswith(f"{router}: 1 of 1 services alive on 1 platforms\n")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["--interval", "0"], "--interval"),
        (["--stale-after", "-1"], "--stale-after"),
        (["--tls-ca", "ca.pem"], "--tls-ca, --tls-certificate and --tls-key together"),
        (["--config", "nowhere.toml"], "nowhere.toml"),
    ],
)
def test_invalid_option_gives_one_line(arguments, text, capsys):
    assert main(["status", "--once", *arguments]) == 2
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1


class Terminal:
    """`sonarpost status` in a terminal of 80 columns and 24 lines."""

    def __init__(self, *arguments):
        self.master, slave = pty.openpty()
        fcntl.ioctl(slave, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))
        environment = {**os.environ, "TERM": "xterm-256color"}
        for name in ("COLUMNS", "LINES", "NO_COLOR"):
            environment.pop(name, None)
        command = [sys.executable, "-m", "sonarpost.cli.main", "status", *arguments]
        self.process = subprocess.Popen(
            command, stdin=slave, stdout=slave, stderr=slave, env=environment, start_new_session=True
        )
        os.close(slave)
        self.text = ""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self):
        while True:
            try:
                data = os.read(self.master, 65536)
            except OSError:  # The process has ended.
                return
            self.text += data.decode(errors="replace")

    def screen(self):
        """Return the last screen: the text after the last cursor-home sequence."""
        return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", self.text.rpartition("\x1b[H")[2])

    def wait(self):
        status = self.process.wait()
        self._thread.join()
        os.close(self.master)
        return status


def ended_cleanly(terminal):
    assert "Traceback" not in terminal.text
    # The main screen and the cursor are restored.
    assert terminal.text.rindex("\x1b[?1049l") > terminal.text.rindex("\x1b[?1049h")
    assert terminal.text.rindex("\x1b[?25h") > terminal.text.rindex("\x1b[?25l")


@pytest.mark.system
def test_sigterm_restores_the_terminal():
    terminal = Terminal("--router", f"tcp/127.0.0.1:{free_port()}", "--interval", "0.1")
    try:
        eventually(lambda: "not reached yet" in terminal.screen(), what="the first screen")
    finally:
        terminal.process.terminate()
        status = terminal.wait()
    assert status == 0
    ended_cleanly(terminal)


def test_live_table_shows_lost_and_restored_router_until_ctrl_c():
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    terminal = Terminal("--router", endpoint, "--interval", "0.1", "--stale-after", "2")
    try:
        eventually(lambda: "not reached yet" in terminal.screen(), what="the first screen")
        session = zenoh.open(router_config([endpoint]))
        platforms = Platforms(session)
        platforms.run(health())
        platforms.run(BROKEN)
        eventually(lambda: "2 of 2 services alive" in terminal.screen() and "no modem" in terminal.screen())
        platforms.end(BROKEN)
        eventually(lambda: re.search(r"uuv_modem +gone", terminal.screen()) is not None, what="the end of a service")
        platforms.close()
        session.close()
        eventually(lambda: "data below is old" in terminal.screen(), what="the end of the router")
        eventually(lambda: "stale (ok)" in terminal.screen(), what="stale health")
        session = zenoh.open(router_config([endpoint]))
        platforms = Platforms(session)
        platforms.run(health())
        eventually(lambda: "1 of 2 services alive" in terminal.screen(), what="the router's return")
        platforms.close()
        session.close()
    finally:
        terminal.process.send_signal(signal.SIGINT)
        status = terminal.wait()
    assert status == 0
    ended_cleanly(terminal)


def test_json_lines_on_a_pipe(router, platforms, platform):
    platforms.run(health())
    command = [sys.executable, "-m", "sonarpost.cli.main", "status", "--router", router, "--json", "--interval", "0.1"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        while not any(s["well"] for s in json.loads(process.stdout.readline())["services"]):
            pass
        process.send_signal(signal.SIGINT)
        assert process.wait() == 0


def test_position_and_age_of_a_vehicle():
    state = FleetState((), True, 0, (VehicleState(RECEIVED_STATUS, 65.0),))
    line = (
        "uuv-1: 41.52510, -70.67120 at 2016-10-12T09:00:00Z, heading 272°, speed 1.5 m/s, depth 12.2 m, altitude 3.5 m,"
        " battery 62 %, images waiting 4, disk 12 GB, received 1 min ago by vessel-1"
    )
    assert line in plain_text(state, (), "tcp/x").splitlines()
    assert any(each.startswith("uuv-1: 41.52510, -70.67120") for each in on_terminal(state))
    measured = SAMPLES["vehicle-range"]
    assert isinstance(measured, VehicleRange)
    state = FleetState((), True, 0, state.vehicles, ((measured, 12.0),))
    assert "uuv-1: 740 m from vessel-1, measured 12 s ago" in plain_text(state, (), "tcp/x").splitlines()
    assert json.loads(as_json(state, (), "now"))["ranges"][0]["distance_m"] == 740.0
    (vehicle,) = json.loads(as_json(state, (), "now"))["vehicles"]
    assert (vehicle["age_s"], vehicle["status"]["lat_deg"]) == (65.0, 41.5251)
    bare = RECEIVED_STATUS.model_copy(update={"status": VehicleStatus(vehicle_id="uuv-1", time_utc_s=0.0)})
    assert vehicle_text(VehicleState(bare, 0.0)) == "uuv-1: no position, received 0 s ago by vessel-1"


def test_statuses_of_vehicles_are_checked_and_limited():
    fleet = FleetTracker()
    key = keys.acoustic_status("vessel-1")
    fleet.add_status(key, b"malformed", 0.0)
    fleet.add_status(keys.acoustic_status("vessel-2"), wire.encode(RECEIVED_STATUS), 0.0)
    for number in range(MAX_VEHICLES + 3):
        name = f"uuv-{number}"
        status = RECEIVED_STATUS.status.model_copy(update={"vehicle_id": name})
        fleet.add_status(
            key, wire.encode(RECEIVED_STATUS.model_copy(update={"vehicle_id": name, "status": status})), 1.0
        )
    measured = SAMPLES["vehicle-range"]
    fleet.add_range(keys.acoustic_range("vessel-2"), wire.encode(measured), 2.0)
    fleet.add_range(keys.acoustic_range("vessel-1"), wire.encode(measured), 2.0)
    state = fleet.state(5.0)
    assert state.ranges == ((measured, 3.0),)
    assert (len(state.vehicles), state.rejected) == (MAX_VEHICLES, 6)
    assert {one.age_s for one in state.vehicles} == {4.0}
