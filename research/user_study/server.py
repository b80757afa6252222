"""Web application of the user study: participants, answers, and images under names without information."""

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
from starlette.routing import Mount, Route
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
from sonarpost.services.console.web.server import STATIC, StaticFolder, page, routing_error
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
    """Image files of the study.

    Attributes:
        originals: Files of the originals, by name without suffix.
        decoded: Files of the decoded images.
    """

    originals: dict[str, Path]
    decoded: dict[Decoded, Path]

    @classmethod
    def read(cls, originals: Path, decoded: Path) -> Folders:
        """Find the images: decoded ones have the names of their originals, in `decoded` or in one folder a group.

        Raises:
            ConfigError: A folder contains no images, or a decoded image has no original.
        """
        known = {path.stem: path for path in _images(originals)}
        found: dict[Decoded, Path] = {}
        for path in _images(decoded):
            found[Decoded("", path.stem)] = path
        if decoded.is_dir():
            for folder in sorted(path for path in decoded.iterdir() if path.is_dir()):
                found |= {Decoded(folder.name, path.stem): path for path in _images(folder)}
        for name, folder, images in (("--originals", originals, known), ("--decoded", decoded, found)):
            if not images:
                raise ConfigError("user_study", name, str(folder), "a folder with PNG or TIFF images")
        for one in found:
            if one.name not in known:
                raise ConfigError(
                    "user_study", "--decoded", str(found[one]), f"an image with an original in {originals}"
                )
        return cls(known, found)


def _images(folder: Path) -> list[Path]:
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file())


class Answers:
    """Durable storage of the answers; each question has one answer.

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
            raise DeliveryError(f"{path}: cannot be opened as a user study: {error}") from error

    def setting(self, name: str, initial: bytes) -> bytes:
        """Return a setting of the study, `initial` for a new study."""
        with self._lock:
            self._db.execute("INSERT OR IGNORE INTO panel VALUES (?, ?)", (name, initial))
            return bytes(self._db.execute("SELECT value FROM panel WHERE name = ?", (name,)).fetchone()[0])

    def answered(self, person: str) -> int:
        """Return the number of answers of a participant; questions are answered in order."""
        with self._lock:
            row = self._db.execute("SELECT COUNT(*) FROM answer WHERE person = ?", (person,)).fetchone()
            return int(row[0])

    def add(self, person: str, number: int, trial: Trial, choice: int, sure: float | None, seconds: float) -> bool:
        """Store an answer; return False if the question was already answered.

        Raises:
            DeliveryError: The answer cannot be stored.
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
class _Participant:
    name: str
    trials: tuple[Trial, ...]
    images: dict[str, Path] = field(default_factory=dict)


class StudyApp:
    """Web application of a user study.

    Args:
        folders: The images.
        answers: Storage of the answers.
        title: Title of the page.
        choices: Number of originals in a trial.
        seed: Seed of the order.
        host: Host name of the server.
        static: Folder with the shared files of the console's page.
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
        self._people: dict[str, _Participant] = {}
        # Report an invalid number of choices at the start.
        trials_for("", self._seed, tuple(folders.originals), folders.decoded, self._choices)
        self._static = static
        access = AccessControl(None, "vessel")

        def endpoint(handler: Handler) -> Endpoint:
            return access.endpoint(handler, needs_session=False)

        routes = [
            Route("/", lambda _: RedirectResponse("/panel", 303)),
            Route("/panel", lambda _: page(OWN_STATIC / "panel.html")),
            Mount("/panel", StaticFolder(directory=OWN_STATIC)),
            Route("/api/panel", endpoint(self._info)),
            Route("/api/panel/start", endpoint(self._start), methods=["POST"]),
            Route("/api/panel/next", endpoint(self._next)),
            Route("/api/panel/answers", endpoint(self._answer), methods=["POST"]),
            Route("/api/panel/results", endpoint(self._results)),
            Route("/api/panel/images/{token}.png", endpoint(self._image)),
            Mount("/static", StaticFolder(directory=static)),
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
            self._people.setdefault(token, _Participant(name, trials))
        return JSONResponse({"panel": token, "answered": self._answers.answered(name)}, 201)

    def _person(self, call: Call) -> _Participant:
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

    def _address(self, person: _Participant, number: int, what: str, path: Path) -> str:
        """Return the address of an image for this participant and question; it does not contain the file name."""
        token = self._signed(f"{person.name}/{number}/{what}")
        with self._lock:
            person.images[token] = path
        return f"/api/panel/images/{token}.png"

    def _image(self, call: Call) -> Response:
        token = str(call.request.path_params["token"])
        with self._lock:
            paths = [person.images[token] for person in self._people.values() if token in person.images]
        if not paths:
            raise ApiError(404, "not_found", "no such image")
        # Encoded again, so that metadata of the file is not sent.
        data = rendering.encode_png(rendering.eight_bits(read_image(paths[0])))
        return Response(data, media_type="image/png")

    def _answer(self, call: Call) -> Response:
        person, answer = self._person(call), call.parse_body(_Answered)
        answered = self._answers.answered(person.name)
        if answer.choice >= self._choices:
            raise ApiError(400, "bad_request", f"-1 to {self._choices - 1}", "choice")
        if answer.number > len(person.trials) or answer.number > answered + 1:
            raise ApiError(400, "bad_request", f"{answered + 1}, the next question", "number")
        trial = person.trials[answer.number - 1]
        if not self._answers.add(person.name, answer.number, trial, answer.choice, answer.sure, answer.seconds):
            raise ApiError(409, "conflict", "this question has been answered", "number")
        return JSONResponse({"answered": self._answers.answered(person.name)}, 201)

    def _results(self, call: Call) -> Response:
        if call.address not in ("127.0.0.1", "::1"):
            raise ApiError(403, "forbidden", "results are available on this host only")
        return JSONResponse(results(self._answers.all(), self._choices))

    def _signed(self, text: str) -> str:
        return hmac.new(self._secret, text.encode("utf-8", "surrogatepass"), hashlib.sha256).hexdigest()[:32]
