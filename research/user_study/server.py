"""The recognition survey's pages: who answers, what was answered, pictures under names that tell nothing."""

from __future__ import annotations

import hashlib
import hmac
import secrets
import sqlite3
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

from pydantic import Field
from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.responses import JSONResponse, RedirectResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from research.user_study.trials import NONE_OF_THEM, Answer, Decoded, Trial, results, trials_for
from sonarpost.errors import ConfigError, DeliveryError
from sonarpost.review import rendering
from sonarpost.services.console.web.access import (
    AccessControl,
    ApiError,
    Call,
    Endpoint,
    Handler,
    RequestBody,
    SecurityMiddleware,
)
from sonarpost.services.console.web.server import STATIC, routing_error, static_file, static_routes
from sonarpost.sonar.image_files import read_image

OWN_STATIC: Final = Path(__file__).parent / "static"
SUFFIXES: Final = (".png", ".tif", ".tiff")
_SCHEMA = """
CREATE TABLE IF NOT EXISTS panel (name TEXT PRIMARY KEY, value BLOB NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS answer (
    person TEXT NOT NULL, number INTEGER NOT NULL, grouped TEXT NOT NULL, shown TEXT NOT NULL, chosen TEXT NOT NULL,
    correct INTEGER NOT NULL, sure REAL, seconds REAL NOT NULL, utc_s REAL NOT NULL, PRIMARY KEY (person, number));
"""


@dataclass(frozen=True, slots=True)
class Folders:
    """The pictures of a panel.

    Attributes:
        originals: Files by name without suffix.
        decoded: Files of the decoded ones.
    """

    originals: dict[str, Path]
    decoded: dict[Decoded, Path]

    @classmethod
    def read(cls, originals: Path, decoded: Path) -> Folders:
        """Find the pictures: decoded ones have the names of their originals, in `decoded` or in one folder a group.

        Raises:
            ConfigError: A folder has no pictures, or a decoded one no original.
        """
        known = {path.stem: path for path in _pictures(originals)}
        found: dict[Decoded, Path] = {}
        for path in _pictures(decoded):
            found[Decoded("", path.stem)] = path
        if decoded.is_dir():
            for folder in sorted(path for path in decoded.iterdir() if path.is_dir()):
                found |= {Decoded(folder.name, path.stem): path for path in _pictures(folder)}
        for name, folder, pictures in (("--originals", originals, known), ("--decoded", decoded, found)):
            if not pictures:
                raise ConfigError("user_study", name, str(folder), "a folder with PNG or TIFF pictures")
        for one in found:
            if one.name not in known:
                raise ConfigError(
                    "user_study", "--decoded", str(found[one]), f"a picture with an original in {originals}"
                )
        return cls(known, found)


def _pictures(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())


class Answers:
    """What was answered, on the disk; nothing is answered twice.

    Raises:
        DeliveryError: The file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._db = sqlite3.connect(path, check_same_thread=False, isolation_level=None, timeout=10)
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.executescript(f"BEGIN; {_SCHEMA} COMMIT;")
        except (OSError, sqlite3.Error) as error:
            raise DeliveryError(f"{path}: cannot be opened as a panel: {error}") from error

    def setting(self, name: str, initial: bytes) -> bytes:
        """Return what the panel was begun with, `initial` for a new one."""
        with self._lock:
            self._db.execute("INSERT OR IGNORE INTO panel VALUES (?, ?)", (name, initial))
            return bytes(self._db.execute("SELECT value FROM panel WHERE name = ?", (name,)).fetchone()[0])

    def answered(self, person: str) -> int:
        """Return how many a person has answered: they are answered in order."""
        with self._lock:
            row = self._db.execute("SELECT COUNT(*) FROM answer WHERE person = ?", (person,)).fetchone()
            return int(row[0])

    def add(self, person: str, number: int, trial: Trial, choice: int, sure: float | None, seconds: float) -> bool:
        """Keep an answer; False where there is one already.

        Raises:
            DeliveryError: It cannot be kept now.
        """
        chosen = "" if choice == NONE_OF_THEM else trial.choices[choice]
        row = (
            person,
            number,
            trial.shown.group,
            trial.shown.name,
            chosen,
            int(choice == trial.right),
            sure,
            seconds,
            time.time(),
        )
        try:
            with self._lock:
                added = self._db.execute("INSERT OR IGNORE INTO answer VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
                return added.rowcount == 1
        except sqlite3.Error as error:
            raise DeliveryError(f"{self.path}: {error}") from error

    def all(self) -> list[Answer]:
        """Return every answer."""
        with self._lock:
            rows = self._db.execute("SELECT person, grouped, correct, seconds FROM answer ORDER BY person, number")
            return [Answer(person, group, bool(right), seconds) for person, group, right, seconds in rows]

    def close(self) -> None:
        """Close the file."""
        with self._lock:
            self._db.close()


class _Start(RequestBody):
    name: Annotated[str, Field(pattern=r"^[^\x00-\x1f]{1,60}$")]


class _Answered(RequestBody):
    number: Annotated[int, Field(ge=1, le=100_000)]
    choice: Annotated[int, Field(ge=NONE_OF_THEM, le=100)]
    sure: Annotated[float, Field(ge=0, le=1)] | None = None
    seconds: Annotated[float, Field(ge=0, le=86400)]


@dataclass
class _Person:
    name: str
    trials: tuple[Trial, ...]
    pictures: dict[str, Path] = field(default_factory=dict)


class PanelApp:
    """A panel as a web application.

    Args:
        folders: Its pictures.
        answers: Where answers are kept.
        title: For the page.
        choices: How many originals are offered at a time.
        seed: Of the order.
        host: Where it is served; its own name in browsers.
        static: Folder of the page.
    """

    def __init__(
        self,
        folders: Folders,
        answers: Answers,
        title: str,
        choices: int,
        seed: int,
        host: str = "127.0.0.1",
        static: Path = STATIC,
    ) -> None:
        self._folders = folders
        self._answers = answers
        self._title = title
        self._choices = int(answers.setting("choices", str(choices).encode()))
        self._seed = int(answers.setting("seed", str(seed).encode()))
        self._secret = answers.setting("secret", secrets.token_bytes(32))
        self._lock = threading.Lock()
        self._people: dict[str, _Person] = {}
        # Wrong choices are told before anybody sits down.
        trials_for("", self._seed, tuple(folders.originals), folders.decoded, self._choices)
        self._static = static
        access = AccessControl(None, "vessel", behind_proxy=False)

        def let(handler: Handler) -> Endpoint:
            return access.endpoint(handler, needs_session=False)

        routes = [
            Route("/", lambda _: RedirectResponse("/panel", 303)),
            Route("/panel", lambda _: static_file(OWN_STATIC, "panel.html")),
            Route("/panel/{path:path}", lambda request: static_file(OWN_STATIC, str(request.path_params["path"]))),
            Route("/api/panel", let(self._info)),
            Route("/api/panel/start", let(self._start), methods=["POST"]),
            Route("/api/panel/next", let(self._next)),
            Route("/api/panel/answers", let(self._answer), methods=["POST"]),
            Route("/api/panel/results", let(self._results)),
            Route("/api/panel/pictures/{token}.png", let(self._picture)),
            *static_routes(static),
        ]
        app = Starlette(routes=routes, exception_handlers={HTTPException: routing_error})
        self.asgi: ASGIApp = SecurityMiddleware(app, (host,), tls=False)

    def _info(self, _call: Call) -> Response:
        return JSONResponse({"title": self._title, "trials": len(self._folders.decoded), "choices": self._choices})

    def _start(self, call: Call) -> Response:
        name = call.parse_body(_Start).name.strip()
        if not name:
            raise ApiError(400, "bad_request", "a name", "name")
        token = self._signed(f"person {name}")
        trials = trials_for(name, self._seed, tuple(self._folders.originals), self._folders.decoded, self._choices)
        with self._lock:
            self._people.setdefault(token, _Person(name, trials))
        return JSONResponse({"panel": token, "answered": self._answers.answered(name)}, 201)

    def _person(self, call: Call) -> _Person:
        with self._lock:
            person = self._people.get(call.request.headers.get("x-panel", ""))
        if person is None:
            raise ApiError(401, "no_session", "start with a name first")
        return person

    def _next(self, call: Call) -> Response:
        person = self._person(call)
        answered = self._answers.answered(person.name)
        if answered >= len(person.trials):
            return JSONResponse({"done": True, "answered": answered})
        trial = person.trials[answered]
        shown = self._address(person, answered, "shown", self._folders.decoded[trial.shown])
        choices = [
            self._address(person, answered, f"choice {number}", self._folders.originals[name])
            for number, name in enumerate(trial.choices)
        ]
        return JSONResponse(
            {
                "number": answered + 1,
                "of": len(person.trials),
                "shown": shown,
                "choices": [*choices],
                "done": False,
            }
        )

    def _address(self, person: _Person, number: int, what: str, path: Path) -> str:
        """Return where a picture is for this person and question: a name that says nothing of the file's."""
        token = self._signed(f"{person.name}/{number}/{what}")
        with self._lock:
            person.pictures[token] = path
        return f"/api/panel/pictures/{token}.png"

    def _picture(self, call: Call) -> Response:
        token = str(call.request.path_params["token"])
        with self._lock:
            paths = [person.pictures[token] for person in self._people.values() if token in person.pictures]
        if not paths:
            raise ApiError(404, "not_found", "no such picture")
        # Drawn anew: a file's own remarks and dates stay here.
        data = rendering.encode_png(rendering.eight_bits(read_image(paths[0])))
        return Response(data, media_type="image/png")

    def _answer(self, call: Call) -> Response:
        person, given = self._person(call), call.parse_body(_Answered)
        answered = self._answers.answered(person.name)
        if given.choice >= self._choices:
            raise ApiError(400, "bad_request", f"-1 to {self._choices - 1}", "choice")
        if given.number > len(person.trials) or given.number > answered + 1:
            raise ApiError(400, "bad_request", f"{answered + 1}, the next question", "number")
        trial = person.trials[given.number - 1]
        if not self._answers.add(person.name, given.number, trial, given.choice, given.sure, given.seconds):
            raise ApiError(409, "conflict", "this question has been answered", "number")
        return JSONResponse({"answered": self._answers.answered(person.name)}, 201)

    def _results(self, call: Call) -> Response:
        if call.address not in ("127.0.0.1", "::1"):
            raise ApiError(403, "forbidden", "results are shown on this host only")
        return JSONResponse(results(self._answers.all(), self._choices))

    def _signed(self, text: str) -> str:
        return hmac.new(self._secret, text.encode("utf-8", "surrogatepass"), hashlib.sha256).hexdigest()[:32]
