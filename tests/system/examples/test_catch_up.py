"""The examples that catch up and then subscribe, as separate processes with a c2.

Rust is tested where the program has been built: in `examples/rust/target`, or in the folder that
`SONARPOST_EXAMPLES_TARGET` names. JavaScript is tested where Node is installed.
"""

import base64
import json
import os
import queue
import re
import shutil
import sys
import threading
from contextlib import ExitStack, contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
import zenoh
from builders.common import REPOSITORY, WAIT_S, eventually, running
from builders.exports import decision, image
from builders.line_program import run_program
from builders.shore import number_images, relayed

from sonarpost import keys, wire
from sonarpost.bus.session import client_config
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

__all__ = ["run_program"]

EXAMPLES = REPOSITORY / "examples"
PYTHON = EXAMPLES / "catch_up.py"
JAVASCRIPT = EXAMPLES / "javascript" / "catch_up.mjs"


@pytest.fixture
def c2(platform, tmp_path):
    with running(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out", json_mirror=True))) as service:
        yield service


@pytest.fixture
def pair(platform, database_url, monkeypatch):
    """Two c2 with one archive that both reply to a query, as for a short time after an outage of the database."""
    monkeypatch.setattr(C2Service, "_prefer_others", lambda *_, **__: None)
    pair = [C2Service(platform(f"shore-{n}"), C2Config(database=database_url, json_mirror=True)) for n in range(1, 3)]
    for service in pair:
        assert service.start()
        service._queries.set_preferred(is_preferred=False)
    yield pair
    for service in pair:
        service.stop()


def accept(c2, *records):
    before = c2.health().counters.get("records_handled", 0)
    for record in records:
        c2.session.put(keys.shore_inbox("vessel-1"), wire.encode(relayed(record)))
    eventually(lambda: c2.health().counters.get("records_handled", 0) == before + len(records), what="acceptance")


def rust_program():
    folder = Path(os.environ.get("SONARPOST_EXAMPLES_TARGET", EXAMPLES / "rust" / "target"))
    for kind in ("release", "debug"):
        if (folder / kind / "catch_up").is_file():
            return str(folder / kind / "catch_up")
    pytest.skip("examples/rust has not been built")


def shown(key, payload, encoding):
    """Return a reply or publication in the form of the plugin."""
    value = base64.b64encode(payload.to_bytes()).decode()
    if encoding == zenoh.Encoding.APPLICATION_JSON:
        value = json.loads(payload.to_bytes())
    elif encoding == zenoh.Encoding.TEXT_PLAIN:
        value = payload.to_string()
    return {"key": key, "value": value, "encoding": str(encoding), "timestamp": None}


class _Server(ThreadingHTTPServer):
    """HTTP server with the documented interface of Zenoh's REST plugin, as far as the JavaScript example uses it.

    The embedded router has no plugins. `GET {selector}` returns a JSON list of replies, with `Accept:
    text/event-stream` server-sent events of publications; the path is the key expression, the query part the
    parameters. As in the plugin, all replies of a key are returned only with a valid `_time`, and only values of the
    encodings `application/json` and `text/plain` are inserted as they are.
    """

    def __init__(self, session):
        super().__init__(("127.0.0.1", 0), _Handler)
        self.session = session
        self.stopping = threading.Event()


class _Handler(BaseHTTPRequestHandler):
    server: _Server

    def do_GET(self):
        url = urlsplit(self.path)
        key = unquote(url.path).lstrip("/")
        if self.headers["accept"] == "text/event-stream":
            self._subscribe(key)
        else:
            self._query(key, url.query)

    def _query(self, key, parameters):
        has_time = any(pair.startswith("_time=[") for pair in parameters.split(";"))
        mode = zenoh.ConsolidationMode.NONE if has_time else zenoh.ConsolidationMode.LATEST
        found = []
        for reply in self.server.session.get(f"{key}?{parameters}", consolidation=mode, timeout=WAIT_S):
            if reply.ok is not None:
                found.append(shown(str(reply.ok.key_expr), reply.ok.payload, reply.ok.encoding))
            elif reply.err is not None:
                found.append(shown("ERROR", reply.err.payload, reply.err.encoding))
        self._head("application/json")
        self.wfile.write(json.dumps(found).encode())

    def _subscribe(self, key):
        samples = queue.Queue()
        subscriber = self.server.session.declare_subscriber(key, samples.put)
        self._head("text/event-stream")
        try:
            while not self.server.stopping.is_set():
                try:
                    sample = samples.get(timeout=0.05)
                except queue.Empty:
                    continue
                data = json.dumps(shown(str(sample.key_expr), sample.payload, sample.encoding))
                self.wfile.write(f"event: PUT\ndata: {data}\n\n".encode())
                self.wfile.flush()
        except ConnectionError:
            return  # the client has gone
        finally:
            subscriber.undeclare()

    def _head(self, content_type):
        self.send_response(200)
        self.send_header("Content-Type", content_type)
        self.end_headers()
        self.wfile.flush()

    def log_message(self, *_):
        """Log nothing."""


@contextmanager
def rest_interface(session):
    """Run the server; yields its address."""
    server = _Server(session)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.stopping.set()
        server.shutdown()
        thread.join()
        server.server_close()


def check(c2, start):
    """Check a program: 300 records missed, then new ones, a repeated one, then a restart with a cursor."""
    number_images(c2, [image(f"{n:04X}") for n in range(1, 301)])
    program = start("")
    lines = program.read(300)
    assert lines == [f"{n} reconstructed_image uuv-1 {n:04X} 1 -" for n in range(1, 301)]
    accept(c2, image("0AAA"), image("0001"), decision("0AAA", verdict="mine_like"))
    assert program.read(2) == ["301 reconstructed_image uuv-1 0AAA 1 -", "302 decision uuv-1 0AAA - mine_like"]
    program.stop()
    assert program.lines.empty()
    archive = c2._archive.index().journal.position()[0]
    accept(c2, image("0BBB"))
    again = start(f"{archive}.301")
    assert again.read(2) == ["302 decision uuv-1 0AAA - mine_like", "303 reconstructed_image uuv-1 0BBB 1 -"]
    again.stop()
    refused = start("00000000.5")
    assert "after: got '00000000.5', expected a cursor of" in refused.wait(1)


def check_pair(pair, start):
    """Check a program with two c2: 300 records missed, half of each c2, then one of them ends."""
    for first in range(1, 301, 10):
        service = pair[first // 10 % 2]
        number_images(service, [image(f"{n:04X}") for n in range(first, first + 10)])
    lines = [f"{n} reconstructed_image uuv-1 {n:04X} 1 -" for n in range(1, 301)]
    program = start("")
    assert program.read(300) == lines
    pair[0].stop()
    accept(pair[1], image("0AAA"))
    lines.append("301 reconstructed_image uuv-1 0AAA 1 -")
    assert program.read(1) == lines[-1:]
    late = start("")
    assert late.read(301) == lines
    for each in (program, late):
        each.stop()
        assert each.lines.empty()


def programs(language, run, router, folder, stack):
    """Return a function that starts the example with a cursor."""
    if language == "rust":
        rust = rust_program()
        return lambda cursor: run(rust, router, cursor)
    if language == "python":

        def start(cursor):
            saved = folder / f"cursor-{len(list(folder.iterdir()))}"
            saved.write_text(cursor)
            return run(sys.executable, "-I", str(PYTHON), router, str(saved))

        return start
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    server = stack.enter_context(rest_interface(stack.enter_context(zenoh.open(client_config([router])))))
    return lambda cursor: run(node, str(JAVASCRIPT), server, cursor)


LANGUAGES = pytest.mark.parametrize("language", ["python", "rust", "javascript"])


@LANGUAGES
def test_program_with_one_c2(language, run_program, c2, router, tmp_path):
    with ExitStack() as stack:
        check(c2, programs(language, run_program, router, tmp_path, stack))


@LANGUAGES
def test_program_with_two_c2(language, run_program, pair, router, tmp_path):
    with ExitStack() as stack:
        check_pair(pair, programs(language, run_program, router, tmp_path, stack))


def test_python_needs_only_zenoh_and_msgpack():
    modules = set(re.findall(r"^(?:import|from) (\w+)", PYTHON.read_text(), re.MULTILINE))
    assert modules - set(sys.stdlib_module_names) == {"zenoh", "msgpack"}
