"""A console without a network, its users, and clients like a browser."""

from __future__ import annotations

import json
import shutil
import ssl
import threading
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from http.client import HTTPResponse
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient

from builders.records import reconstructed_image
from sonarpost.messages import Contact, Pixels, ReconstructedImage
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.database import Database
from sonarpost.services.console.store.users import Users
from sonarpost.services.console.web.server import ConsoleApp

PASSWORD = "correct horse battery"
ROLES_OF_USERS = {"watch": "observer", "anna": "operator", "bo": "operator", "eva": "expert"}
FIRST_UTC_S = 1_700_000_000.0


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

    def decide(self, contact_id: str, **changes: Any) -> httpx2.Response:
        """Decide on the newest version of a contact's image."""
        detail = self.contact(contact_id)
        version = detail["versions"][-1]
        body = {
            "revision": detail["contact"]["revision"],
            "version": version["version"],
            "sha256": version["sha256"],
            "layer": "raw",
            "verdict": "mine_like",
            "confidence": 0.8,
            "mlo_class": "manta",
            "remark": "clean edge",
        }
        return self.post(f"/api/contacts/{contact_id}/decisions", {**body, **changes})


class EventReader:
    """Reads the event stream in a thread, as an open page does.

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
            f"{address}events{query}", None, {"Cookie": f"sonarpost_session={token}", **headers}
        )
        self._stream: HTTPResponse = urllib.request.urlopen(request, timeout=60, context=context)
        self.events: list[tuple[str, str, Any]] = []
        self.ended = False
        threading.Thread(target=self._read, daemon=True).start()

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


ConsoleMaker = Callable[..., Console]


@pytest.fixture(autouse=True)
def fast_password_hashes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reduce the cost of password hashes."""
    monkeypatch.setattr("sonarpost.services.console.store.users.SCRYPT_COST", 2**4)


@pytest.fixture(scope="session")
def users_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of users, made once for all tests."""
    path = tmp_path_factory.mktemp("users") / "console-users.db"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sonarpost.services.console.store.users.SCRYPT_COST", 2**4)
        users = Users(path)
        for name, role in ROLES_OF_USERS.items():
            users.add(name, role, PASSWORD)
        users.close()
    return path


@pytest.fixture
def make_console(tmp_path: Path, users_file: Path) -> Iterator[ConsoleMaker]:
    consoles: list[Console] = []

    def make(**options: Any) -> Console:
        folder = tmp_path / str(len(consoles))
        folder.mkdir()
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
def console(make_console: ConsoleMaker) -> Console:
    return make_console()
