"""Write the screenshots of the console in docs/explanation/console, with simulated contacts (`make screenshots`).

Needs Debian's Chromium (apt-get install chromium), or another one that SONARPOST_CHROMIUM names.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from sonarpost.messages import Advice
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import Board
from sonarpost.services.console.store.contacts import Filter
from sonarpost.services.console.store.database import Database, OnScreen
from sonarpost.services.console.store.decisions import DecisionInput
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.store.users import Actor, Users
from sonarpost.services.console.training.simulator import VESSEL, Training
from sonarpost.services.console.web.server import ConsoleApp, WebServer

OUT = Path(__file__).resolve().parents[1] / "docs" / "explanation" / "console"
SMALL, LARGE = (1366, 768), (1920, 1080)
BOB = Actor("bob", "operator", "127.0.0.1")
BEFORE, IN_ALL = 34, 60
MOST_BYTES = 300_000


class Scene:
    """A training console whose contacts have been reviewed in part."""

    def __init__(self, board: Board, users: Users, address: str, browser: Browser) -> None:
        self.board, self.address, self._browser = board, address, browser
        self._token = users.begin("anna").token
        rows = board.contacts(Filter(limit=200, sort="confidence"))["items"]
        self.rows: list[Json] = [row for row in rows if row["has_picture"]]

    def contact(self, *, complete: bool, of: int = 0) -> str:
        """Return one of the contacts about which the detector is surest."""
        found = [row["id"] for row in self.rows if row["complete"] == complete and row["range_m"] > 6]
        return str(found[of])

    def judge(self, contact_id: str, verdict: str, confidence: float, mlo_class: str | None, remark: str) -> None:
        """Decide as another operator."""
        whole = self.board.contact(contact_id)
        version = whole["versions"][-1]
        screen = OnScreen(version["version"], version["sha256"], "raw")
        revision = whole["contact"]["revision"]
        self.board.decide(contact_id, DecisionInput(revision, screen, verdict, confidence, mlo_class, remark), BOB)  # type: ignore[arg-type]

    @contextmanager
    def page(self, size: tuple[int, int], theme: str, contact_id: str = "") -> Iterator[Page]:
        """Open the page in a theme, at a contact."""
        width, height = size
        context = self._browser.new_context(
            viewport={"width": width, "height": height},
            color_scheme="dark" if theme == "night" else "light",
            reduced_motion="reduce",
        )
        context.add_cookies([{"name": "sonarpost_session", "value": self._token, "url": self.address}])
        page = context.new_page()
        page.add_init_script("localStorage.setItem('sonarpost.review', '')")
        page.goto(f"{self.address}#{quote(contact_id, safe='')}")
        page.wait_for_function("id => document.querySelector('canvas')?.dataset.shows?.includes(id)", arg=contact_id)
        yield page
        context.close()


def press(page: Page, *keys: str) -> None:
    """Press keys one after the other."""
    for key in keys:
        page.keyboard.press(key)


def shoot(page: Page, name: str) -> None:
    """Save what is on the screen, in at most 256 colours."""
    path = OUT / f"{name}.png"
    page.wait_for_function("() => [...document.images].every(one => one.complete || !one.checkVisibility())")
    page.screenshot(path=path)
    with Image.open(path) as shot:
        shot.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    if path.stat().st_size > MOST_BYTES:
        raise SystemExit(f"{path}: {path.stat().st_size} bytes, at most {MOST_BYTES} wanted")
    print(f"{path.relative_to(OUT.parents[1])}: {path.stat().st_size} bytes")


def review_part(scene: Scene) -> None:
    """Let others have been at work."""
    verdicts = [
        ("mine_like", 0.9, "manta", "clear edge, long shadow"),
        ("not_mine_like", 0.8, None, "rock"),
        ("mine_like", 0.7, "cylinder", ""),
        ("unsure", 0.4, None, "want another look"),
    ]
    for number, (verdict, confidence, mlo_class, remark) in enumerate(verdicts):
        scene.judge(str(scene.rows[3 + 2 * number]["id"]), verdict, confidence, mlo_class, remark)


def measured(scene: Scene) -> None:
    """By day, small: the shadow of a contact is measured."""
    contact_id = scene.contact(complete=True, of=0)
    with scene.page(SMALL, "day", contact_id) as page:
        shadow(page)
        press(page, "Enter")
        page.wait_for_selector('details[data-name="measurements"]')
        page.focus("#queue")
        page.wait_for_selector("#toasts p", state="detached")
        shoot(page, "review-day-1366")


def shadow(page: Page) -> None:
    """Measure the shadow, which begins left of the picture's middle."""
    press(page, "m", "m", "m", *["Shift+ArrowLeft"] * 4, "Enter", *["Shift+ArrowRight"] * 3, "Enter")
    page.wait_for_selector(".hint >> text=Enter keeps it")


def decided(scene: Scene) -> None:
    """By night, large: decided, with advice from the shore, delivered."""
    contact_id = scene.contact(complete=True, of=0)
    row = scene.board.contact(contact_id)["contact"]
    advice = Advice(
        advice_id="advice-1",
        vessel_id=VESSEL,
        vehicle_id=row["vehicle_id"],
        image_id=row["image_id"],
        image_version=row["version"],
        verdict="mine_like",
        confidence=0.8,
        mlo_class="manta",
        remark="same outline as last week's",
        author="eva",
        advised_utc_s=scene.board.clock() - 40.0,
    )
    scene.board.take_advice(advice)
    with scene.page(LARGE, "night", contact_id) as page:
        press(page, "1", "g", "ArrowRight", *["ArrowRight"] * 5, "w")
        page.keyboard.type("highlight and shadow agree")
        page.keyboard.press("Control+Enter")
        page.wait_for_selector(".progress >> text=on the vehicle")
        page.wait_for_selector('.progress >> text="ashore"')
        press(page, "s")
        page.wait_for_selector("#toasts p", state="detached")
        shoot(page, "decision-night-1920")


def partly_there(scene: Scene) -> None:
    """By night, small: a picture of which half is missing."""
    halves = [row["id"] for row in scene.rows if 30 < row["percent_received"] < 70]
    with scene.page(SMALL, "night", str(halves[0])) as page:
        press(page, "c", "c", "c")
        shoot(page, "partial-night-1366")


def asked(scene: Scene) -> None:
    """By day, small: what asking for more would cost."""
    with scene.page(SMALL, "day", scene.contact(complete=False, of=1)) as page:
        press(page, "r")
        page.wait_for_selector("dialog .costs")
        shoot(page, "ask-day-1366")


def conflict(scene: Scene) -> None:
    """By day, large: another operator was faster."""
    contact_id = scene.contact(complete=True, of=4)
    with scene.page(LARGE, "day", contact_id) as page:
        press(page, "1")
        scene.judge(contact_id, "not_mine_like", 0.8, None, "a boulder; no man-made edge")
        page.wait_for_selector(".now >> text=changed since you chose")
        press(page, "Enter")
        page.wait_for_selector("dialog .versus")
        shoot(page, "conflict-day-1920")


def around(scene: Scene) -> None:
    """The map by day and the link by night, small and large."""
    contact_id = scene.contact(complete=True, of=0)
    with scene.page(SMALL, "day", contact_id) as page:
        press(page, "p")
        page.wait_for_function("() => document.querySelector('.map canvas').width > 300")
        press(page, *["j"] * 8)
        page.wait_for_selector(".map .card")
        shoot(page, "map-day-1366")
    with scene.page(SMALL, "night", contact_id) as page:
        press(page, "f")
        page.wait_for_selector(".heard li")
        shoot(page, "link-night-1366")


def main() -> None:
    """Make all of them."""
    chromium = os.environ.get("SONARPOST_CHROMIUM") or shutil.which("chromium")
    if chromium is None:
        raise SystemExit("no Chromium: apt-get install chromium, or set SONARPOST_CHROMIUM")
    OUT.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        folder = Path(scratch)
        config = ConsoleConfig(port=0, vessel_lat_deg=56.4495, vessel_lon_deg=-5.6012)
        database, users = Database(folder / "review.db"), Users(folder / "users.db")
        users.add("anna", "operator", "correct horse battery")
        board = Board(config, database)
        app = ConsoleApp(board, users, VESSEL, training=True)
        server = WebServer(app.asgi, config.host, config.port)
        training = Training(board, IN_ALL, seed=7, interval_s=2.0)
        training.backlog(BEFORE)
        server.start()
        training.start()
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = playwright.chromium.launch(executable_path=chromium, args=arguments)
        try:
            scene = Scene(board, users, server.address, browser)
            review_part(scene)
            for make in (measured, decided, partly_there, asked, conflict, around):
                make(scene)
        finally:
            browser.close()
            training.stop()
            app.end()
            server.stop()
            users.close()
            database.close()


if __name__ == "__main__":
    sys.exit(main())
