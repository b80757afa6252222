"""Write the screenshots of the console in docs/explanation/console, with simulated contacts (`make screenshots`).

Needs Debian's Chromium (apt-get install chromium), or another one that SONARPOST_CHROMIUM names.
"""

import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote, urlsplit

from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from sonarpost.extensions.training.simulator import RATE, VESSEL, TrainingSimulator
from sonarpost.messages import Comment
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.contacts import ContactFilter
from sonarpost.services.console.store.database import Actor, Database, DisplayedImage
from sonarpost.services.console.store.decisions import DecisionInput
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.store.users import Users
from sonarpost.services.console.web.access import COOKIE, cookie_name
from sonarpost.services.console.web.server import ConsoleApp, WebServer

OUT = Path(__file__).resolve().parents[1] / "docs" / "explanation" / "console"
PHONE, TABLET, SMALL, LARGE = (390, 844), (1024, 768), (1366, 768), (1920, 1080)
BOB = Actor("bob", "operator", "127.0.0.1")
BACKLOG, CONTACTS = 34, 60
MAX_BYTES = 400_000


class Scene:
    """A training console whose contacts are partly reviewed."""

    def __init__(self, state: ConsoleState, users: Users, address: str, browser: Browser) -> None:
        self.state, self.address, self._browser = state, address, browser
        self._users = users
        rows = state.list_contacts(ContactFilter(limit=200, sort="confidence"))["items"]
        self.rows: list[Json] = [row for row in rows if row["has_image"]]

    def contact(self, *, complete: bool, index: int = 0) -> str:
        """Return one of the contacts with the highest confidence of the detector."""
        found = [row["id"] for row in self.rows if row["complete"] == complete and row["range_m"] > 6]
        return str(found[index])

    def looks(self) -> str:
        """Return a contact that is one of several looks at an object."""
        return next(str(row["id"]) for row in self.rows if row["looks"] > 1)

    def decide(self, contact_id: str, verdict: str, confidence: float, mlo_class: str | None, remark: str) -> None:
        """Decide as another operator."""
        detail = self.state.contact_detail(contact_id)
        version = detail["versions"][-1]
        displayed = DisplayedImage(version["version"], version["sha256"], "raw")
        revision = detail["contact"]["revision"]
        self.state.decide(contact_id, DecisionInput(revision, displayed, verdict, confidence, mlo_class, remark), BOB)  # type: ignore[arg-type]

    @contextmanager
    def page(self, size: tuple[int, int], theme: str, contact_id: str, user: str = "anna") -> Iterator[Page]:
        """Open the page at a contact."""
        token = self._users.start_session(user).token
        width, height = size
        context = self._browser.new_context(
            viewport={"width": width, "height": height},
            color_scheme="dark" if theme == "night" else "light",
            reduced_motion="reduce",
        )
        context.add_cookies(
            [{"name": cookie_name(COOKIE, urlsplit(self.address).netloc), "value": token, "url": self.address}]
        )
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


def decide(page: Page, key: str) -> None:
    """Press the key of a verdict when verdicts count: the image has been in sight for 0.3 s."""
    page.wait_for_selector('.decision[data-ready="true"]')
    press(page, key)


def save(page: Page, name: str) -> None:
    """Save a screenshot with at most 256 colours."""
    path = OUT / f"{name}.png"
    page.wait_for_function("() => [...document.images].every(one => one.complete || !one.checkVisibility())")
    page.screenshot(path=path)
    with Image.open(path) as shot:
        shot.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
    if path.stat().st_size > MAX_BYTES:
        raise SystemExit(f"{path}: {path.stat().st_size} bytes, expected at most {MAX_BYTES}")
    print(f"{path.relative_to(OUT.parents[1])}: {path.stat().st_size} bytes")


def add_decisions(scene: Scene) -> None:
    """Store decisions of another operator."""
    verdicts = [
        ("mine_like", 0.9, "manta", "clear edge, long shadow"),
        ("not_mine_like", 0.8, None, "rock"),
        ("mine_like", 0.7, "cylinder", ""),
        ("unsure", 0.4, None, "want another look"),
    ]
    for number, (verdict, confidence, mlo_class, remark) in enumerate(verdicts):
        scene.decide(str(scene.rows[3 + 2 * number]["id"]), verdict, confidence, mlo_class, remark)


def measurement(scene: Scene) -> None:
    """Day theme, small: a measured shadow."""
    contact_id = scene.contact(complete=True, index=0)
    with scene.page(SMALL, "day", contact_id) as page:
        press(page, "m", "m", "m", *["Shift+ArrowLeft"] * 2, "Enter", *["Shift+ArrowRight"] * 3, "Enter")
        page.wait_for_selector(".size-panel >> text=±")
        press(page, "Enter")
        page.wait_for_selector('details[data-name="measurements"]')
        page.focus("#queue")
        page.wait_for_selector("#toasts p", state="detached")
        save(page, "review-day-1366")


def decision(scene: Scene) -> None:
    """Night theme, large: a delivered decision and a comment from the shore site, two versions side by side."""
    contact_id = scene.contact(complete=True, index=0)
    row = scene.state.contact_detail(contact_id)["contact"]
    comment = Comment(
        comment_id="comment-1",
        vessel_id=VESSEL,
        vehicle_id=row["vehicle_id"],
        image_id=row["image_id"],
        image_version=row["version"],
        verdict="mine_like",
        confidence=0.8,
        mlo_class="manta",
        remark="same outline as last week's",
        author="eva",
        commented_utc_s=scene.state.clock() - 40.0,
    )
    scene.state.store_comment(comment)
    with scene.page(LARGE, "night", contact_id) as page:
        page.click('[data-confidence="0.9"]')
        press(page, "w")
        page.keyboard.type("highlight and shadow agree")
        press(page, "Escape")
        decide(page, "1")
        page.wait_for_selector("#result >> text=mine-like")
    with scene.page(LARGE, "night", contact_id) as page:
        page.wait_for_selector(".standing .counts .good >> nth=1")
        press(page, "s")
        page.wait_for_selector("#toasts p", state="detached")
        save(page, "decision-night-1920")


def partial_image(scene: Scene) -> None:
    """Night theme, small: an image whose half is missing."""
    halves = [row["id"] for row in scene.rows if not row["complete"] and row["percent_received"] == 50]
    with scene.page(SMALL, "night", str(halves[0])) as page:
        save(page, "partial-night-1366")


def request(scene: Scene) -> None:
    """Day theme, small: the costs of requests."""
    with scene.page(SMALL, "day", scene.contact(complete=False, index=1)) as page:
        press(page, "r")
        page.wait_for_selector("[data-request]:focus")
        save(page, "requests-day-1366")


def dispute(scene: Scene) -> None:
    """Day theme, large: a contact that two operators dispute."""
    contact_id = scene.contact(complete=True, index=4)
    with scene.page(LARGE, "day", contact_id) as page:
        scene.decide(contact_id, "not_mine_like", 0.8, None, "a boulder; no man-made edge")
        page.wait_for_selector(".overrule")
        decide(page, "1")
        page.wait_for_selector(".standing .badge.disputed")
        save(page, "disputed-day-1920")


def grid(scene: Scene) -> None:
    """Day theme, small: the images of all contacts."""
    with scene.page(SMALL, "day", scene.contact(complete=True, index=0)) as page:
        page.click(".grid-button")
        page.wait_for_selector(".review.grid .row >> nth=20")
        save(page, "grid-day-1366")


def views(scene: Scene) -> None:
    """The map, the link and an object with two looks."""
    contact_id = scene.contact(complete=True, index=0)
    with scene.page(SMALL, "day", contact_id) as page:
        press(page, "p")
        page.wait_for_selector(".map[data-drawn]")
        press(page, *["j"] * 8)
        page.wait_for_selector(".map .card")
        page.wait_for_timeout(800)
        save(page, "map-day-1366")
    with scene.page(SMALL, "night", contact_id) as page:
        press(page, "f")
        page.wait_for_selector(".fleet article")
        save(page, "link-night-1366")
    with scene.page(SMALL, "night", scene.looks()) as page:
        page.click(".open-object")
        page.wait_for_selector("dialog canvas")
        page.wait_for_timeout(1000)
        save(page, "object-night-1366")


def small_screens(scene: Scene) -> None:
    """A tablet and a phone."""
    with scene.page(TABLET, "night", scene.contact(complete=True, index=2)) as page:
        save(page, "review-night-1024")
    with scene.page(PHONE, "day", scene.contact(complete=True, index=2)) as page:
        save(page, "review-day-390")


def score(scene: Scene) -> None:
    """Day theme, tablet: the score of the training."""
    with scene.page(TABLET, "day", scene.contact(complete=True, index=0), user="eva") as page:
        page.click("#menu")
        page.click('.menu [data-item="score"]')
        page.wait_for_selector("dialog .score")
        save(page, "score-day-1024")


def main() -> None:
    """Write all screenshots."""
    chromium = os.environ.get("SONARPOST_CHROMIUM") or shutil.which("chromium")
    if chromium is None:
        raise SystemExit("no Chromium: apt-get install chromium, or set SONARPOST_CHROMIUM")
    OUT.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch, sync_playwright() as playwright:
        folder = Path(scratch)
        config = ConsoleConfig(port=0, vessel_lat_deg=56.4495, vessel_lon_deg=-5.6012, assumed_rate=RATE)
        database, users = Database(folder / "review.db"), Users(folder / "users.db")
        for name, role in (("anna", "operator"), ("eva", "expert")):
            users.add(name, role, "correct horse battery")
        state = ConsoleState(config, database)
        app = ConsoleApp(state, users, VESSEL, training=True)
        server = WebServer(app.asgi, config.host, config.port)
        simulator = TrainingSimulator(state, CONTACTS, seed=7, interval_s=2.0)
        simulator.load_backlog(BACKLOG)
        server.start()
        simulator.start()
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = playwright.chromium.launch(executable_path=chromium, args=arguments)
        try:
            scene = Scene(state, users, server.address, browser)
            add_decisions(scene)
            for take in (measurement, decision, partial_image, request, dispute, grid, views, small_screens, score):
                take(scene)
        finally:
            browser.close()
            simulator.stop()
            app.stop()
            server.stop()
            users.close()
            database.close()


if __name__ == "__main__":
    sys.exit(main())
