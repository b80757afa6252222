"""A console without a network, its users, and clients like a browser."""

import json
import shutil
import ssl
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPResponse
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx2
import numpy as np
import numpy.typing as npt
import pytest
from starlette.testclient import TestClient

from builders.common import WAIT_S, eventually
from builders.records import reconstructed_image
from sonarpost import keys, wire
from sonarpost.config import TlsConfig
from sonarpost.messages import (
    AcousticFrame,
    Comment,
    Contact,
    DownlinkState,
    Health,
    Pixels,
    QueuedImage,
    QueueState,
    ReconstructedImage,
)
from sonarpost.security.fleet import CA_CERTIFICATE, CERTIFICATE, KEY, Fleet
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contacts import ContactFilter
from sonarpost.services.console.store.database import Database
from sonarpost.services.console.store.users import Users
from sonarpost.services.console.web.access import COOKIE, cookie_name
from sonarpost.services.console.web.server import ConsoleApp, WebServer

PASSWORD = "correct horse battery"
ROLES_OF_USERS = {"watch": "observer", "anna": "operator", "bo": "operator", "eva": "expert"}
FIRST_UTC_S = 1_700_000_000.0
VESSEL = "vessel-1"


def image_record(
    image_id: str = "00A7",
    version: int = 1,
    *,
    vehicle: str = "uuv-1",
    vessel: str = "vessel-1",
    missing_rows: int = 0,
    total: int = 200,
    seed: int = 0,
    position: tuple[float, float] | None = (56.0, -5.0),
    first_utc_s: float = FIRST_UTC_S,
    **contact_fields: Any,
) -> ReconstructedImage:
    """A version of an image of 40 x 60 px whose last rows are missing."""
    pixels = np.random.default_rng(seed + version).integers(0, 256, (40, 60), dtype=np.uint8)
    mask = np.zeros(pixels.shape, np.bool_)
    if missing_rows:
        mask[-missing_rows:] = True
        pixels[mask] = 0
    fields: dict[str, Any] = {
        "altitude_m": 5.0,
        "ground_range_m": 12.0,
        "channel": "starboard",
        "heading_deg": 0.0,
        "pixel_along_m": 0.1,
        "pixel_across_m": 0.05,
        "atd_confidence": 1.2,
        "time_utc_s": first_utc_s - 100,
    }
    lat, lon = position or (None, None)
    contact = Contact(
        contact_id=f"{vehicle}/{image_id}", vehicle_id=vehicle, lat_deg=lat, lon_deg=lon, **{**fields, **contact_fields}
    )
    return reconstructed_image(
        Pixels.from_array(pixels),
        vessel_id=vessel,
        vehicle_id=vehicle,
        image_id=image_id,
        version=version,
        contact=contact,
        codec="emb",
        complete=not missing_rows,
        missing_fraction=float(mask.mean()),
        missing_mask=np.packbits(mask).tobytes() if missing_rows else b"",
        bytes_received=total if not missing_rows else total * (40 - missing_rows) // 40,
        bytes_total=total,
        frames_received=version,
        first_frame_utc_s=first_utc_s,
        last_frame_utc_s=first_utc_s + version,
    )


def partial_record(
    image_id: str = "00A7",
    version: int = 1,
    received: int = 30,
    *,
    complete: bool = False,
    total: int = 0,
    **fields: Any,
) -> ReconstructedImage:
    """A version as the v1 link delivers it: no frames, and no length before the plan has arrived."""
    changes = {"complete": complete, "bytes_received": received, "bytes_total": received if complete else total}
    record = image_record(image_id, version, **fields)
    return record.model_copy(update={**changes, "frames_received": 0, "despeckle_strength": 1.0})


def with_pixels(record: ReconstructedImage, pixels: npt.NDArray[np.uint8]) -> ReconstructedImage:
    """The record with another image, all of it received."""
    packed = Pixels.from_array(pixels)
    return record.model_copy(update={"pixels": packed, "pixels_sha256": packed.sha256, "missing_mask": b""})


def contact_id(image_id: str = "00A7", vehicle: str = "uuv-1") -> str:
    """The contact of an `image_record` whose first frame was received at `FIRST_UTC_S`."""
    return f"sonarpost.{VESSEL}.{vehicle}.20231114T221320Z.{image_id}"


def contact_ids(state: ConsoleState) -> dict[str, str]:
    """Contact identifiers by image identifier."""
    return {row["image_id"]: row["id"] for row in state.list_contacts(ContactFilter(limit=500))["items"]}


def received_frame(time_utc_s: float | None = None, packet: int = 1, number: int = 1, **changes: Any) -> AcousticFrame:
    """A frame of three of a packet that a vehicle has sent; received now."""
    fields = {
        "direction": "rx",
        "platform_id": VESSEL,
        "time_utc_s": time.time() if time_utc_s is None else time_utc_s,
        "source": 3,
        "destination": 1,
        "rate": 1,
        "packet": packet,
        "frame_number": number,
        "frame_count": 3,
        "data": b"x",
    }
    return AcousticFrame.model_validate(fields | changes)


def queue_state(images: Sequence[tuple[str, int, float]], time_utc_s: float, waiting: int | None = None) -> QueueState:
    """The queue of uuv-1 with images (identifier, bytes left, expected time)."""
    queued = [
        QueuedImage(image_id=name, contact_id="c", bytes_left=left, preview_utc_s=None, expected_utc_s=expected_utc_s)
        for name, left, expected_utc_s in images
    ]
    return QueueState(
        platform_id="uuv-1",
        time_utc_s=time_utc_s,
        rate=1,
        frame_loss=None,
        packet_interval_s=6.0,
        messages_waiting=0,
        message_bytes=0,
        images_waiting=len(queued) if waiting is None else waiting,
        images=tuple(queued),
    )


def downlink_state(kind: str, record_id: str, state: str, now_utc_s: float, **changes: Any) -> DownlinkState:
    """State of a record that the vessel sends to uuv-1."""
    fields = {"vessel_id": VESSEL, "vehicle_id": "uuv-1", "kind": kind, "record_id": record_id, "state": state}
    times = {"times_sent": 1, "expires_utc_s": now_utc_s + 3600.0, "changed_utc_s": now_utc_s}
    return DownlinkState.model_validate(fields | times | changes)


def comment_record(image_id: str = "00A7", **changes: Any) -> Comment:
    """A comment of eva on the first version of an image."""
    names = {"vessel_id": VESSEL, "vehicle_id": "uuv-1", "image_id": image_id, "image_version": 1}
    fields = {"comment_id": "a-1", "author": "eva", "commented_utc_s": FIRST_UTC_S + 50, "remark": "look again"}
    return Comment.model_validate(names | fields | changes)


def health_record(
    service: str,
    platform_id: str = VESSEL,
    state: str = "ok",
    detail: str = "",
    time_utc_s: float = 1000.0,
    **gauges: Any,
) -> Health:
    times = {"time_utc_s": time_utc_s, "started_utc_s": time_utc_s}
    fields = {"platform_id": platform_id, "service": service, "state": state, "detail": detail, "counters": {}}
    return Health.model_validate({**fields, **times, "gauges": gauges})


def encoded_health(*words: Any, **fields: Any) -> tuple[str, bytes]:
    """Key and payload of a `health_record`."""
    record = health_record(*words, **fields)
    return keys.health(record.platform_id, record.service), wire.encode(record)


@dataclass
class Browser:
    """A browser, with or without a session."""

    client: httpx2.Client
    csrf: str = ""

    def login(self, user: str, password: str = PASSWORD) -> httpx2.Response:
        answer = self.client.post("/api/login", json={"user": user, "password": password})
        if answer.status_code == 200:
            self.csrf = answer.json()["csrf"]
        return answer

    def get(self, path: str, **parameters: Any) -> httpx2.Response:
        return self.client.get(path, params=parameters or None, follow_redirects=False)

    def post(self, path: str, body: Any, **headers: str) -> httpx2.Response:
        return self.client.post(path, json=body, headers={"X-CSRF-Token": self.csrf, **headers})

    def contact(self, contact_id: str) -> Any:
        return self.get(f"/api/contacts/{contact_id}").json()

    def displayed(self, contact_id: str) -> dict[str, Any]:
        """What a decision states about the newest version of a contact's image."""
        version = self.contact(contact_id)["versions"][-1]
        return {"version": version["version"], "sha256": version["sha256"], "layer": "raw"}

    def decide(self, contact_id: str, **changes: Any) -> httpx2.Response:
        """Decide on the newest version of a contact's image."""
        body = {
            "revision": self.contact(contact_id)["contact"]["revision"],
            "verdict": "mine_like",
            "confidence": 0.8,
            "mlo_class": "manta",
            "remark": "clean edge",
        }
        return self.post(f"/api/contacts/{contact_id}/decisions", {**body, **self.displayed(contact_id), **changes})

    def undo(self, contact_id: str, decision_id: str, **changes: Any) -> httpx2.Response:
        body = {"decision_id": decision_id, **self.displayed(contact_id), **changes}
        return self.post(f"/api/contacts/{contact_id}/undo", body)

    def chart(self) -> dict[str, dict[str, Any]]:
        """Contacts on the map by image identifier."""
        found = self.get("/api/map").json()
        contacts = [dict(zip(found["columns"], row, strict=True)) for row in found["contacts"]]
        return {one["name"].rpartition("/")[2]: one for one in contacts}

    def rows(self, **parameters: Any) -> dict[str, Any]:
        """Rows of the list of contacts by image identifier, in its order."""
        return {row["image_id"]: row for row in self.get("/api/contacts", **parameters).json()["items"]}


def session_cookie(address: str) -> str:
    """The name of the session's cookie of the console at an address."""
    return cookie_name(COOKIE, urlsplit(address).netloc)


class EventReader:
    """Reads the event stream in a thread, as an open page does; events after the construction are received.

    Args:
        address: URL of the server.
        token: Token of a session.
        query: Query string of the request.
        context: TLS context; None for HTTP.
        headers: Additional HTTP headers.
    """

    def __init__(
        self, address: str, token: str, query: str = "", context: ssl.SSLContext | None = None, **headers: str
    ) -> None:
        request = urllib.request.Request(
            f"{address}events{query}", None, {"Cookie": f"{session_cookie(address)}={token}", **headers}
        )
        self._stream: HTTPResponse = urllib.request.urlopen(request, timeout=WAIT_S, context=context)
        self.events: list[tuple[str, str, Any]] = []
        self.ended = False
        threading.Thread(target=self._read, daemon=True).start()
        # The answer comes before the stream is subscribed, its first event after.
        eventually(lambda: bool(self.events) or self.ended, what="first event")

    def _read(self) -> None:
        identifier = name = ""
        try:
            for raw in self._stream:
                field, _, value = raw.decode().rstrip("\n").partition(": ")
                if field == "id":
                    identifier = value
                elif field == "event":
                    name = value
                elif field == "data":
                    self.events.append((name, identifier, json.loads(value)))
        except (OSError, ValueError, AttributeError):
            pass  # closed by the test
        self.ended = True

    def names(self) -> list[str]:
        return [name for name, _, _ in self.events]

    def close(self) -> None:
        self._stream.close()


def server_certificate(folder: Path) -> TlsConfig:
    """A certificate of a fleet for servers at 127.0.0.1."""
    issued = Fleet.init(folder / "pki", "test").issue("vessel-1", "vessel", hosts=("127.0.0.1",)).folder
    return TlsConfig(ca=issued / CA_CERTIFICATE, certificate=issued / CERTIFICATE, key=issued / KEY)


@dataclass
class Console:
    """A console with its users."""

    state: ConsoleState
    users: Users
    app: ConsoleApp

    def browser(self, user: str = "") -> Browser:
        browser = Browser(TestClient(self.app.asgi, base_url="http://127.0.0.1:8470"))
        if user:
            assert browser.login(user).status_code == 200
        return browser


class Clock:
    """Replaces the clock of a console's state."""

    def __init__(self, console: Console, now_utc_s: float = FIRST_UTC_S) -> None:
        self.now_utc_s = now_utc_s
        console.state.clock = lambda: self.now_utc_s

    def advance(self, seconds: float) -> None:
        self.now_utc_s += seconds


ConsoleMaker = Callable[..., Console]


@pytest.fixture(autouse=True, scope="module")
def fast_password_hashes() -> Iterator[None]:
    """Reduce the cost of password hashes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sonarpost.services.console.store.users.SCRYPT_COST", 2**4)
        yield


@pytest.fixture(scope="module")
def users_file(fast_password_hashes: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of users, made once for the tests of a module."""
    path = tmp_path_factory.mktemp("users") / "console-users.db"
    users = Users(path)
    for name, role in ROLES_OF_USERS.items():
        users.add(name, role, PASSWORD)
    users.close()
    return path


def _console_maker(tmp_path_factory: pytest.TempPathFactory, users_file: Path) -> Iterator[ConsoleMaker]:
    consoles: list[Console] = []

    def make(**options: Any) -> Console:
        folder = tmp_path_factory.mktemp("console")
        shutil.copy(users_file, folder)
        config = ConsoleConfig(**options)
        users = Users(folder / users_file.name, config.session_s, config.session_max_s)
        state = ConsoleState(config, Database(folder / "console-review.db"))
        consoles.append(Console(state, users, ConsoleApp(state, users, "vessel-1")))
        return consoles[-1]

    yield make
    for console in consoles:
        console.state.database.close()
        console.users.close()


@pytest.fixture
def make_console(tmp_path_factory: pytest.TempPathFactory, users_file: Path) -> Iterator[ConsoleMaker]:
    yield from _console_maker(tmp_path_factory, users_file)


@pytest.fixture(scope="module")
def make_shared_console(tmp_path_factory: pytest.TempPathFactory, users_file: Path) -> Iterator[ConsoleMaker]:
    """Makes consoles that the tests of a module only read."""
    yield from _console_maker(tmp_path_factory, users_file)


@pytest.fixture
def console(make_console: ConsoleMaker) -> Console:
    return make_console()


@contextmanager
def web_server(console: Console, *words: Any, **options: Any) -> Iterator[WebServer]:
    """A running server of a console."""
    server = WebServer(console.app.asgi, "127.0.0.1", 0, *words, **options)
    server.start()
    try:
        yield server
    finally:
        console.app.stop()
        server.stop()
