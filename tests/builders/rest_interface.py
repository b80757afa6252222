"""HTTP server with the documented interface of Zenoh's REST plugin, as far as the JavaScript example uses it.

The embedded router has no plugins. `GET {selector}` returns a JSON list of replies, with `Accept: text/event-stream`
server-sent events of publications; the path is the key expression, the query part the parameters. As in the plugin,
all replies of a key are returned only with a valid `_time`, and only values of the encodings `application/json` and
`text/plain` are inserted as they are.
"""

import base64
import json
import queue
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

import zenoh

from builders.common import WAIT_S


def shown(key, payload, encoding):
    """Return a reply or publication in the form of the plugin."""
    value = base64.b64encode(payload.to_bytes()).decode()
    if encoding == zenoh.Encoding.APPLICATION_JSON:
        value = json.loads(payload.to_bytes())
    elif encoding == zenoh.Encoding.TEXT_PLAIN:
        value = payload.to_string()
    return {"key": key, "value": value, "encoding": str(encoding), "timestamp": None}


class _Server(ThreadingHTTPServer):
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
