"""Exports with their limits, and the printable report."""

import csv
import io
import os
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import threading
import weakref
import zipfile
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path

import httpx2
import numpy as np
import pytest
from builders.common import eventually
from builders.console import PASSWORD, Browser, contact_id, image_record, session_cookie, web_server
from PIL import Image

from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.database import Database
from sonarpost.services.console.web import export_routes
from sonarpost.services.console.web.export_routes import ExportRoutes

ID = contact_id()


def test_exports_contain_the_filtered_contacts(console):
    console.state.store_image(image_record("0001"))
    console.state.store_image(image_record("0002", vehicle="uuv-2", position=None))
    anna = console.browser("anna")
    anna.decide(contact_id("0001"))
    table = anna.get("/api/export/contacts.csv")
    assert "attachment" in table.headers["content-disposition"]
    rows = list(csv.DictReader(io.StringIO(table.content.decode("utf-8-sig"))))
    assert {row["name"]: row["review"] for row in rows} == {"uuv-1/0001": "mine_like", "uuv-2/0002": "unreviewed"}
    only = anna.get("/api/export/contacts.geojson", review="mine_like").json()
    assert [feature["properties"]["name"] for feature in only["features"]] == ["uuv-1/0001"]
    assert only["unlocated"] == []
    offered = anna.get("/api/info").json()["exports"]
    assert offered.keys() >= {"csv", "geojson", "kmz", "gpkg"}
    for ending in offered:
        assert b"0002" not in anna.get(f"/api/export/contacts.{ending}", to_utc_s="1700000000").content, ending
    with zipfile.ZipFile(io.BytesIO(anna.get("/api/export/contacts.kmz").content)) as archive:
        assert any(name.endswith(".kml") for name in archive.namelist())
        assert any(name.endswith(".png") for name in archive.namelist())
    with sqlite3.connect(":memory:") as db:
        db.deserialize(anna.get("/api/export/contacts.gpkg").content)
        rows = db.execute("SELECT name, review, geom IS NULL, image FROM contacts ORDER BY fid").fetchall()
    assert [row[:3] for row in rows] == [("uuv-1/0001", "mine_like", 0), ("uuv-2/0002", "unreviewed", 1)]
    assert np.array_equal(Image.open(io.BytesIO(rows[0][3])), image_record("0001").pixels.to_array())
    assert anna.get("/api/export/contacts.exe").status_code == 404


def test_report_shows_known_and_unknown_values(console):
    console.state.store_image(image_record(missing_rows=10, altitude_m=None))
    anna = console.browser("anna")
    anna.decide(ID)
    page = anna.get(f"/report/{ID}").text
    assert "data:image/png;base64," in page
    assert "25.0 % (hatched in the image)" in page
    assert '<dt>Altitude of the vehicle</dt><dd><span class="missing">unknown</span></dd>' in page
    assert "clean edge" in page
    assert "style=" not in page


class Held:
    """Exports wait between two contacts until `leave` is set."""

    def __init__(self) -> None:
        self.leave = threading.Event()
        self.entered = threading.Semaphore(0)
        self.running = self.most_running = 0

    def wait(self, *_arguments: object) -> None:
        self.running += 1
        self.most_running = max(self.most_running, self.running)
        self.entered.release()
        assert self.leave.wait(120)
        self.running -= 1


@pytest.fixture
def held(console, monkeypatch):
    console.state.store_image(image_record())
    held = Held()
    monkeypatch.setattr(ExportRoutes, "_check", held.wait)
    yield held
    held.leave.set()


@pytest.fixture
def client_of(console):
    """Clients of a real server, by user."""
    clients = []
    with web_server(console) as server:

        def make(user):
            cookies = {session_cookie(server.address): console.users.start_session(user).token}
            clients.append(httpx2.Client(base_url=server.address, cookies=cookies, timeout=120))
            return clients[-1]

        yield make
        for client in clients:
            client.close()


def error_of(answer: httpx2.Response) -> tuple[int, str]:
    return answer.status_code, answer.json()["error"]["code"]


def test_exports_run_one_at_a_time_and_their_number_is_limited(console, client_of, held):
    console.users.add("another", "observer", PASSWORD)
    watch, probe = client_of("watch"), client_of("anna")
    clients = [client_of(user) for user in ("anna", "bo", "eva", "another")]
    with ThreadPoolExecutor(20) as pool:
        first = pool.submit(watch.get, "/api/export/contacts.kmz")
        assert held.entered.acquire(timeout=120)
        repeated = list(pool.map(lambda _: watch.get("/api/export/contacts.kmz"), range(10)))
        assert {error_of(answer) for answer in repeated} == {(429, "too_many")}
        assert all(int(answer.headers["retry-after"]) > 0 for answer in repeated)
        others = [pool.submit(client.get, "/api/export/contacts.csv") for client in clients]
        [full] = wait(others, 120, FIRST_COMPLETED).done
        assert error_of(full.result()) == (503, "busy")
        assert int(full.result().headers["retry-after"]) > 0
        # Other requests are answered while four exports are open.
        assert probe.get("/api/contacts").json()["total"] == 1
        assert not first.done()
        held.leave.set()
        done = [one.result().status_code for one in (first, *others) if one is not full]
    assert done == [200] * 4
    assert held.most_running == 1
    assert watch.get("/api/export/contacts.csv").status_code == 200


def test_reports_are_limited_like_exports(console, client_of, held):
    watch, anna = client_of("watch"), client_of("anna")
    with ThreadPoolExecutor(4) as pool:
        first = pool.submit(watch.get, "/report")
        assert held.entered.acquire(timeout=120)
        for path in ("/report", "/api/export/contacts.csv"):
            answer = watch.get(path)
            assert error_of(answer) == (429, "too_many")
            assert int(answer.headers["retry-after"]) > 0
        assert anna.get("/login").status_code == 200
        assert anna.get(f"/report/{ID}").status_code == 200
        held.leave.set()
        assert first.result().text.count("class='sheet'") == 1
    assert anna.get("/report").status_code == 200


def test_aborted_download_ends_the_export(console, client_of):
    console.state.store_image(image_record())
    watch = client_of("watch")
    for _ in range(3):
        with watch.stream("GET", "/api/export/contacts.kmz") as answer:
            codes = [answer.status_code]
        eventually(lambda: console.app._exports._queue._exports == {}, what="end of the export")
        assert codes == [200]


def test_failed_export_does_not_stay_in_the_queue(console, monkeypatch):
    watch = console.browser("watch")
    monkeypatch.setattr(export_routes, "HANDLING_RESERVE_BYTES", 2**62)
    console.state.store_image(image_record())
    for _ in range(2):
        assert error_of(watch.get("/api/export/contacts.csv")) == (503, "not_now")
    monkeypatch.undo()
    assert watch.get("/api/export/contacts.csv").status_code == 200


def test_export_leaves_half_of_the_free_disk(console, monkeypatch):
    console.state.store_image(image_record())
    watch = console.browser("watch")
    free = iter((2**40, 2**39, 2**40, 2**39 - 1))
    monkeypatch.setattr(export_routes.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(2**41, 0, next(free)))
    assert watch.get("/api/export/contacts.csv").status_code == 200
    assert error_of(watch.get("/api/export/contacts.csv")) == (413, "too_large")


def test_cut_connection_ends_the_export(console, client_of, monkeypatch):
    console.state.store_image(image_record())
    started, leave, check = threading.Event(), threading.Event(), ExportRoutes._check

    def repeat(*arguments):
        started.set()
        while not leave.is_set():
            check(*arguments)

    monkeypatch.setattr(ExportRoutes, "_check", repeat)
    watch = client_of("watch")
    try:
        with socket.create_connection((watch.base_url.host, watch.base_url.port)) as connection:
            cookie = "; ".join(f"{name}={value}" for name, value in watch.cookies.items())
            host = watch.base_url.netloc.decode()
            head = f"GET /api/export/contacts.gpkg HTTP/1.1\r\nHost: {host}\r\nCookie: {cookie}\r\n\r\n"
            connection.sendall(head.encode())
            assert started.wait(120)
        eventually(lambda: console.app._exports._queue._exports == {}, what="end of the export")
    finally:
        leave.set()


def test_images_of_an_export_are_in_memory_one_at_a_time(console, monkeypatch):
    for number in range(5):
        console.state.store_image(image_record(f"000{number}", first_utc_s=1_700_000_000.0 + number))
    made, alive = [], []
    decode = export_routes.rendering.eight_bits

    def eight_bits(pixels: object) -> object:
        found = decode(pixels).copy()
        made.append(weakref.ref(found))
        alive.append(sum(image() is not None for image in made))
        return found

    monkeypatch.setattr(export_routes.rendering, "eight_bits", eight_bits)
    assert console.browser("watch").get("/api/export/contacts.kmz").status_code == 200
    assert len(alive) == 5
    assert max(alive) <= 2


def test_stop_ends_a_running_export(console):
    console.state.store_image(image_record())
    watch = console.browser("watch")
    console.app.stop()
    assert error_of(watch.get("/api/export/contacts.kmz")) == (503, "busy")


SERVE = """
from argparse import Namespace
from pathlib import Path
from sonarpost.cli.console import serve_page
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.database import Database

folder = Path({folder!r})
state = ConsoleState(ConsoleConfig(), Database(folder / "console-review.db"))
options = Namespace(port=0, open=False, password={password!r})
serve_page(options, state, folder, [("watch", "observer")], "vessel-1", "")
"""


@pytest.mark.system
@pytest.mark.parametrize(
    ("end", "ending"), [(signal.SIGTERM, "kmz"), (signal.SIGKILL, "kmz"), (signal.SIGKILL, "gpkg")]
)
def test_no_file_remains_after_the_end_of_the_process(tmp_path, end, ending):
    state, temporary = tmp_path / "state", tmp_path / "tmp"
    temporary.mkdir()
    database = Database(state / "console-review.db")
    records = [image_record(f"{number:04X}", first_utc_s=1_700_000_000.0 + number) for number in range(150)]
    ConsoleState(ConsoleConfig(), database).store_images(records)
    database.close()
    code = SERVE.format(folder=str(state), password=PASSWORD)
    before = {path.name for path in state.iterdir()}
    with subprocess.Popen(
        [sys.executable, "-c", code], env={**os.environ, "TMPDIR": str(temporary)}, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            address = process.stdout.readline().split()[0]
            with httpx2.Client(base_url=address, timeout=120) as client, ThreadPoolExecutor() as pool:
                eventually(lambda: is_served(client), what="server")
                assert Browser(client).login("watch", PASSWORD).status_code == 200
                export = pool.submit(client.get, f"/api/export/contacts.{ending}")
                eventually(lambda: is_exporting(process.pid, state) or export.done(), what="export")
                assert not export.done()
                process.send_signal(end)
                process.wait(120)
                # A terminated console may complete a running response; a killed one cannot.
            assert export.exception() is not None or end == signal.SIGTERM
        finally:
            process.kill()
    left = {path.name for path in state.iterdir()} - before - {"console-users.db"}
    assert {name for name in left if not name.endswith(("-wal", "-shm"))} == set()
    assert [path for path in temporary.rglob("*") if "export" in path.name] == []


def is_served(client: httpx2.Client) -> bool:
    try:
        return client.get("/login").status_code == 200
    except httpx2.TransportError:
        return False


def is_exporting(pid: int, folder: Path) -> bool:
    """Return whether a process has an unnamed file open in a folder."""
    names = []
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):
            names.append(str(link.readlink()))
    return any(name.startswith(f"{folder}/") and name.endswith("(deleted)") for name in names)
