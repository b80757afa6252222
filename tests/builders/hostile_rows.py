"""Table of attacks: on which surface which source does what, and which other source is measured during it.

`tests/security/test_hostile.py` runs the rows with a function. A row with a test is covered by that test.
`tests/security/test_surfaces.py` checks that each surface of the product has a row.
"""

import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from random import Random
from typing import Literal

import msgpack
import zenoh

from builders.extensions import modules
from builders.hostile_site import HOSTILE, Site, coded_part, threads
from sonarpost import keys, wire
from sonarpost.messages import ImagePart

Attack = Literal["claim", "flood", "slow", "endless", "junk", "replay", "crash"]
Function = Callable[[Site], AbstractContextManager[None]]


@dataclass(frozen=True, slots=True)
class Row:
    """An attack.

    Attributes:
        surface: Patterns of surfaces, as `builders.surfaces` names them.
        source: Who attacks.
        attack: Kind.
        function: Starts the attack; it ends with the context. Or path of the tests that attack.
        measured: Method of `Site`, or another function: the other source that is measured during the attack.
    """

    surface: tuple[str, ...]
    source: str
    attack: Attack
    function: Function | str
    measured: str | Callable[[Site], list[float]] = "images_of_vessel"

    @property
    def name(self) -> str:
        """Name of the test."""
        assert callable(self.function)
        return f"{self.function.__name__}-{getattr(self.measured, '__name__', self.measured)}"

    def delays_s(self, site: Site) -> list[float]:
        """Measure the other source; return the delays of its records."""
        return (getattr(site, self.measured) if isinstance(self.measured, str) else partial(self.measured, site))()


PART, INBOX = keys.shore_part(HOSTILE), keys.shore_inbox(HOSTILE)


# A vessel at the shore's router


@contextmanager
def records_that_claim_pixels(site: Site) -> Iterator[None]:
    """53 bytes that claim 4096 x 4096 pixels, without a stream."""
    claim = {"type": "part", "v": 1, "u": "uuv-1", "n": 1, "t": 1.0, "h": 4096, "w": 4096}
    site.sender(HOSTILE).send(PART, "c2", [msgpack.packb(claim | {"i": f"{n:04d}"}) for n in range(40)])
    yield


@contextmanager
def images_of_512_pixels(site: Site) -> Iterator[None]:
    """The largest images that are valid, in few bytes each."""
    parts = [ImagePart(u="uuv-1", i=f"{n:04d}", n=2, t=2.0, h=512, w=512) for n in range(400)]
    large = coded_part(9996, 512)
    parts += [large.model_copy(update={"i": f"{n:04d}", "n": 4}) for n in range(100)]
    site.sender(HOSTILE).send(PART, "c2", [wire.encode(part) for part in parts])
    yield


@contextmanager
def many_images(site: Site) -> Iterator[None]:
    """300 valid images at once."""
    site.sender(HOSTILE).send(PART, "c2", [wire.encode(coded_part(n)) for n in range(300)])
    yield


@contextmanager
def one_image_again(site: Site) -> Iterator[None]:
    """One valid image 500 times."""
    site.sender(HOSTILE).send(PART, "c2", [wire.encode(coded_part(9998))] * 500)
    yield


@contextmanager
def junk_on_keys(site: Site) -> Iterator[None]:
    """Mutated records and noise on every key that a vessel may write."""
    random, valid = Random(3), wire.encode(coded_part(9997))
    payloads = [random.randbytes(random.randrange(300)) for _ in range(40)]
    for _ in range(80):
        mutated = bytearray(valid)
        for _ in range(3):
            mutated[random.randrange(len(mutated))] = random.randrange(256)
        payloads.append(bytes(mutated))
    payloads += [
        b"\x81" * 60_000,
        b"\xdd\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff",
        b"\xdf\xff\xff\xff\xff" + b"\x01" * 99,
    ]
    for key in (PART, INBOX):
        site.sender(HOSTILE).send(key, "c2", payloads)
    yield


@contextmanager
def junk_states(site: Site) -> Iterator[None]:
    """Floods of noise on the keys to which the console and watchers subscribe."""
    session, random = site.opened(HOSTILE), Random(4)
    own = [
        keys.health(HOSTILE, "relay"),
        keys.acoustic_status(HOSTILE),
        keys.acoustic_range(HOSTILE),
        keys.acoustic_rx(HOSTILE),
    ]

    def flood(_number: int, stop: threading.Event) -> None:
        while not stop.wait(0.001):
            session.put(random.choice(own), random.randbytes(200))

    with threads(1, flood):
        yield


@contextmanager
def codebooks_without_end(site: Site) -> Iterator[None]:
    """Images that name 40 codebooks, of which the vessel sends one byte a piece, nothing, or all but the last piece."""
    session = site.opened(HOSTILE)

    def answer(query: zenoh.Query) -> None:
        with query:
            offset = int(str(query.parameters.get("offset", "0")))
            kind = int(str(query.key_expr)[-2:], 16) % 3
            if kind == 0:
                query.reply(query.key_expr, msgpack.packb({"v": 1, "size": 16 << 20, "data": b"x"}))
            elif kind == 1 and offset < (16 << 20) - 32768:
                query.reply(query.key_expr, msgpack.packb({"v": 1, "size": 16 << 20, "data": bytes(32768)}))
            else:
                threading.Event().wait(12.0)

    queryable = session.declare_queryable(keys.codebook_all(HOSTILE), answer)
    stream = b"\x00\x00\x33" + bytes(100)
    parts = [
        ImagePart(u="uuv-1", i=f"{n:04d}", n=3, t=3.0, h=48, w=48, p=stream, a=bytes([*[n] * 16])) for n in range(40)
    ]
    site.sender(HOSTILE).send(PART, "c2", [wire.encode(part) for part in parts])
    yield
    queryable.undeclare()


@contextmanager
def queries_without_end(site: Site) -> Iterator[None]:
    """Queries for everything with pixels as JSON, by six threads of one observer, and junk parameters."""
    session = site.opened("observer-1")

    def ask(number: int, stop: threading.Event) -> None:
        parameters = [
            "?limit=256;format=json;pixels=png",
            "?limit=256;pixels=raw",
            f"?after={'9' * 900}",
            "?_time=[..[",
        ]
        while not stop.is_set():
            for _ in session.get(keys.shore_contact_all() + parameters[number % 4], timeout=5.0):
                pass
            for _ in session.get(keys.tasking_state_all() + parameters[number % 4], timeout=5.0):
                pass

    with threads(6, ask):
        yield


@contextmanager
def false_deliveries(site: Site) -> Iterator[None]:
    """Junk queries to the delivery of its own inbox, and to the presence of the site."""
    session, random = site.opened(HOSTILE), Random(5)

    def ask(_number: int, stop: threading.Event) -> None:
        while not stop.is_set():
            for key in (
                keys.delivery_query(PART, "c2"),
                keys.delivery_query(INBOX, "c2"),
                keys.presence(HOSTILE, "c2", keys.SHORE),
            ):
                for _ in session.get(f"{key}?{random.randbytes(20).hex()}", payload=random.randbytes(400), timeout=5.0):
                    pass

    with threads(2, ask):
        yield


@contextmanager
def tasking_of_user(site: Site) -> Iterator[None]:
    """Junk and valid comments from a console for all vessels."""
    random, sender = Random(6), site.sender("console-1")
    comment = {
        "type": "comment",
        "v": 1,
        "comment_id": "a",
        "vessel_id": HOSTILE,
        "vehicle_id": "uuv-1",
        "image_id": "AAAA",
    }
    comment |= {"image_version": 1, "verdict": "unsure", "author": "ben", "commented_utc_s": 2.0}
    for key in (keys.tasking_comment(HOSTILE), keys.tasking_command(HOSTILE)):
        sender.send(key, "c2", [random.randbytes(100) for _ in range(50)])
        sender.send(key, "c2", [msgpack.packb(comment | {"comment_id": f"{n}"}) for n in range(300)])
    yield


@contextmanager
def killed_decoder(site: Site) -> Iterator[None]:
    """The decoding processes of c2 are killed, as the kernel does without memory."""

    def kill(_number: int, stop: threading.Event) -> None:
        for _ in range(20):
            if stop.wait(0.5):
                return
            for pid in site.processes["c2"].pids()[1:]:
                if b"decode_worker" in Path(f"/proc/{pid}/cmdline").read_bytes():
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)

    with threads(1, kill):
        yield


def connections(port: int, count: int, head: bytes, interval_s: float) -> AbstractContextManager[None]:
    """Connections that send a byte at intervals, and are opened again."""

    def drip(_number: int, stop: threading.Event) -> None:
        while not stop.is_set():
            with suppress(OSError), socket.create_connection(("127.0.0.1", port), 5) as opened:
                opened.sendall(head)
                while not stop.wait(interval_s):
                    opened.sendall(b"x")

    return threads(count, drip)


# The console


@contextmanager
def reports_of_observer(site: Site) -> Iterator[None]:
    """Parallel reports and exports of one observer."""
    cookie = site.log_in("ben")

    def ask(number: int, stop: threading.Event) -> None:
        while not stop.is_set():
            site.get(("/report", "/api/export/csv", "/api/export/geopackage")[number % 3], cookie)

    with threads(30, ask):
        yield


@contextmanager
def slow_browsers(site: Site) -> Iterator[None]:
    """200 connections without a session, one byte every 2 s."""
    with connections(site.console_port, 200, b"GET / HTTP/1.1\r\nX: ", 2.0):
        yield


@contextmanager
def event_streams(site: Site) -> Iterator[None]:
    """Event streams that are not read."""
    cookie = site.log_in("ben")
    head = f"GET /events HTTP/1.1\r\nHost: 127.0.0.1:{site.console_port}\r\nCookie: {cookie}\r\n\r\n".encode()
    with connections(site.console_port, 60, head, 3.0):
        yield


@contextmanager
def wrong_passwords(site: Site) -> Iterator[None]:
    """Log-in attempts of one client for many users."""

    def guess(number: int, stop: threading.Event) -> None:
        while not stop.is_set():
            site.get("/api/login", method="POST", body=b'{"user": "u%d", "password": "%s"}' % (number, b"x" * 900))

    with threads(8, guess):
        yield


@contextmanager
def junk_requests(site: Site) -> Iterator[None]:
    """Every route with numbers of 5000 digits, junk and large bodies, with and without a session; none replies 500."""
    from builders.surfaces import console_routes

    random, cookies = Random(8), ("", site.log_in("ben"))
    for method, path in console_routes():
        if path == "/events":
            continue  # its reply has no end
        for cookie in cookies:
            for value in ("9" * 5000, "%00", "..%2f..%2f", "\N{SNOWMAN}".encode().hex()):
                body = None if method == "GET" else random.choice((random.randbytes(300), b"[" * 30_000, b"{}"))
                filled = "".join(
                    part.partition("}")[2].join((value, "")) if n else part for n, part in enumerate(path.split("{"))
                )
                assert site.get(filled, cookie, method, body) != 500, (method, path, value[:10])
    yield


# A program of the vehicle, and its folders


@contextmanager
def junk_snippets(site: Site) -> Iterator[None]:
    """Noise and images that claim pixels, in place of snippets and commands."""
    random, sender = Random(9), site.sender("uuv-1")
    pixels = {"height_px": 4096, "width_px": 4096, "bits": 8, "data": b""}
    claim = {"type": "snippet", "v": 1, "contact": {"contact_id": "x", "vehicle_id": "uuv-1"}, "pixels": pixels}
    for key in (keys.contact_detected("uuv-1"), keys.command("uuv-1", "refine")):
        sender.send(key, "compressor", [*(random.randbytes(200) for _ in range(100)), msgpack.packb(claim)])
    yield


@contextmanager
def hostile_recordings(site: Site) -> Iterator[None]:
    """Descriptions that name devices, pipes and invalid paths; files that are no recordings."""
    os.mkfifo(site.folder / "pipe")
    (site.incoming / "loop.png").symlink_to("loop.png")
    for number, value in enumerate(
        ("/dev/zero", str(site.folder / "pipe"), "a\\u0000b", "x" * 510, "loop.png", "../token")
    ):
        text = f'port = "{value}"\nnavigation = "{value}"\nrange_m = 30.0\n'
        (site.incoming / f"bad{number}.waterfall.toml").write_text(text)
    for suffix in ("xtf", "jsf", "sl2", "png"):
        (site.incoming / f"noise.{suffix}").write_bytes(Random(10).randbytes(4096))
    (site.incoming / "folder.xtf").mkdir()
    yield


def rows() -> list[Row]:
    """Return the attacks on the core, and those of `attacks.py` of the tests of each extension."""
    return [*ROWS, *(row for module in modules("attacks") for row in module.ROWS)]


ROWS: tuple[Row, ...] = (
    Row(("zenoh:*/inbox/{vessel}/part",), "vessel", "claim", records_that_claim_pixels),
    Row(("zenoh:*/inbox/{vessel}/part",), "vessel", "claim", images_of_512_pixels),
    Row(("zenoh:*/inbox/{vessel}/part",), "vessel", "flood", many_images),
    Row(("zenoh:*/inbox/{vessel}/part",), "vessel", "replay", one_image_again),
    Row(("zenoh:*/inbox/{vessel}", "zenoh:*/inbox/{vessel}/part"), "vessel", "junk", junk_on_keys),
    Row(
        (
            "queryable:delivery.inbox",
            "queryable:bus.connectivity",
            "subscriber:delivery.inbox",
            "zenoh:*/hello/{service}",
        ),
        "vessel",
        "junk",
        false_deliveries,
    ),
    Row(
        ("zenoh:*/acoustic/status", "zenoh:*/acoustic/range", "subscriber:services.console.service"),
        "vessel",
        "flood",
        junk_states,
        "requests_of_user",
    ),
    Row(("zenoh:*/codebook/*",), "vessel", "endless", codebooks_without_end),
    Row(("queryable:services.c2.queries",), "observer", "flood", queries_without_end, "queries_of_console"),
    Row(("queryable:services.c2.queries",), "observer", "flood", queries_without_end),
    Row(("zenoh:*/tasking/{vessel}/*",), "console", "junk", tasking_of_user),
    Row(("zenoh:*/inbox/{vessel}/part",), "the machine", "crash", killed_decoder),
    Row(("route:GET /report*", "route:* /api/export*"), "observer", "flood", reports_of_observer, "requests_of_user"),
    Row(
        ("port:services.console.*", "port:cli.console", "port:network.connections"),
        "client",
        "slow",
        slow_browsers,
        "requests_of_user",
    ),
    Row(("route:GET /events",), "observer", "slow", event_streams, "requests_of_user"),
    Row(("route:POST /api/login*",), "client", "flood", wrong_passwords, "requests_of_user"),
    Row(("route:*",), "observer", "junk", junk_requests, "requests_of_user"),
    Row(
        ("zenoh:*/contact/detected", "zenoh:*/command/{kind}"),
        "a program of the vehicle",
        "junk",
        junk_snippets,
        "snippets_of_detector",
    ),
    Row(("folder:atd_stub.input_dir",), "a file", "crash", hostile_recordings, "recording_of_sonar"),
    # Rows of other tests
    Row(("exchange:network.http_client",), "server", "endless", "tests/network/test_http_client.py"),
    Row(("exchange:bus.connectivity",), "router", "slow", "tests/bus/test_connectivity.py"),
    Row(("zenoh:*/inbox/{vessel}/frame",), "another vessel", "junk", "tests/security/test_other_vessels.py"),
    Row(("zenoh:*/status/{vessel}",), "vessel", "junk", "tests/services/console/test_service.py"),
    Row(
        ("zenoh:*/acoustic/queue", "subscriber:services.atd_stub.release"),
        "a program of the vehicle",
        "junk",
        "tests/services/atd_stub/test_release.py",
    ),
    Row(
        (
            "zenoh:*/acoustic/transmissions",
            "queryable:services.uuv_modem.service",
            "subscriber:services.atd_stub.transmissions",
        ),
        "a program of the vehicle",
        "junk",
        "tests/services/atd_stub/test_transmissions.py",
    ),
    Row(
        ("zenoh:*/image/encoded", "zenoh:*/message/outgoing"),
        "a program of the vehicle",
        "junk",
        "tests/services/uuv_modem/test_v1.py",
    ),
    Row(
        ("zenoh:*/{vehicle}/status", "subscriber:services.uuv_modem.service"),
        "a program of the vehicle",
        "junk",
        "tests/services/uuv_modem/test_status.py",
    ),
    Row(("zenoh:*/{vessel}/acoustic/image",), "vehicle", "flood", "tests/services/op_modem/test_image_limiter.py"),
    Row(
        ("zenoh:*/{vessel}/comment", "zenoh:*/{vessel}/contact/decision", "zenoh:*/{vessel}/image/*"),
        "every certificate",
        "junk",
        "tests/security/test_delivery_matrix.py",
    ),
    Row(("queryable:archive.codebook_transfer",), "shore", "junk", "tests/services/test_codebook_transfer.py"),
    Row(("subscriber:bus.catch_up",), "vessel", "junk", "tests/cli/test_c2_live.py"),
    Row(("subscriber:monitoring.fleet",), "vessel", "junk", "tests/monitoring/test_fleet.py"),
    Row(("port:runtime.modem_port",), "another host", "junk", "tests/modem/test_udp.py"),
    Row(("folder:platform.state_dir",), "a damaged disk", "junk", "tests/runtime/test_store_damage.py"),
    Row(("folder:platform.tls.*",), "a file", "junk", "tests/security/test_tls_files.py"),
    Row(("folder:platform.acoustic_key_file",), "a file", "junk", "tests/security/test_acoustic_key.py"),
    Row(
        ("folder:c2.out_dir", "folder:decompressor.out_dir"),
        "a file",
        "junk",
        "tests/services/c2/test_storage.py",
    ),
    Row(("folder:console.tiles_dir",), "a file", "junk", "tests/services/console/test_security.py"),
    Row(
        ("folder:atd_stub.survey_options", "folder:atd_stub.snippet_dir", "folder:atd_stub.quarantine_dir"),
        "a file",
        "junk",
        "tests/services/atd_stub/test_input_files.py",
    ),
    Row(("folder:*_file",), "a file", "junk", "tests/archive/test_postgresql.py"),
)
