"""A real browser in front of a console: Debian's Chromium, driven by Playwright. Nothing outside may be reached."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import pytest
from builders.console import cheap_hashes, console, make_console, users_file
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Request, sync_playwright

from sonarpost.services.console.store.users import Users
from sonarpost.services.console.web.server import ConsoleApp, WebServer

__all__ = ["cheap_hashes", "console", "make_console", "users_file"]

SMALL = {"width": 1366, "height": 768}
PATIENCE_MS = 20_000


@pytest.fixture(scope="module")
def chromium() -> Iterator[Browser]:
    """The browser, one for the tests of a file."""
    path = os.environ.get("SONARPOST_CHROMIUM") or shutil.which("chromium")
    if path is None:
        pytest.skip("no Chromium: apt-get install chromium, or set SONARPOST_CHROMIUM")
    # Chromium's own sandbox refuses to run as root, as containers often do; nothing but the console is opened.
    arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
    # No name but this host's is ever found.
    arguments += ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=arguments)
        yield browser
        browser.close()


class Visit:
    """Somebody's page, of which everything that goes wrong is written down."""

    def __init__(self, context: BrowserContext, address: str) -> None:
        self.address = address
        self.outside: list[str] = []
        self.errors: list[str] = []
        self.allowed: tuple[str, ...] = ()
        self.page: Page = context.new_page()
        self.page.set_default_timeout(PATIENCE_MS)
        self.page.on("pageerror", lambda error: self.errors.append(f"script: {error}"))
        self.page.on("console", self._says)
        self.page.on("request", self._asks)

    def _says(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self.errors.append(f"{message.text} ({message.location.get('url', '')})")

    def _asks(self, request: Request) -> None:
        if urlsplit(request.url).netloc != urlsplit(self.address).netloc and not request.url.startswith(
            ("blob:", "data:")
        ):
            self.outside.append(request.url)

    def may_say(self, *parts: str) -> None:
        """Expect errors on the browser's console with one of these parts: refusals that the test provokes."""
        self.allowed += parts

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)

    def text(self, selector: str) -> str:
        return self.page.locator(selector).first.inner_text()

    def wait(self, selector: str, **options: Any) -> Any:
        return self.page.wait_for_selector(selector, **options)

    def until(self, expression: str, argument: Any = None) -> None:
        """Wait until an expression of the page's JavaScript holds."""
        self.page.wait_for_function(expression, arg=argument)

    def shows(self, image_id: str) -> None:
        """Wait until a contact and its picture are on the screen."""
        self.until("id => document.querySelector('.heading h2')?.textContent.endsWith(id)", image_id)
        self.until("id => document.querySelector('canvas').dataset.shows?.includes(`.${id} `)", image_id)

    def pixels(self, selector: str = ".stage canvas") -> int:
        """How many of a canvas' pixels differ from its first: whether anything is drawn."""
        return int(
            self.page.evaluate(
                """selector => {
                  const canvas = document.querySelector(selector);
                  const image = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
                  const data = new Uint32Array(image.data.buffer);
                  return data.reduce((sum, value) => sum + (value !== data[0]), 0);
                }""",
                selector,
            )
        )

    def check(self) -> None:
        """Nothing went wrong, and nothing outside was asked for."""
        unexpected = [error for error in self.errors if not any(part in error for part in self.allowed)]
        assert unexpected == []
        assert self.outside == []


Visitor = Callable[..., Visit]


@pytest.fixture
def visit(chromium: Browser) -> Iterator[Callable[..., Visit]]:
    """Opens pages of a console: `visit(address, token)`; at the end each must have been without errors."""
    contexts: list[BrowserContext] = []
    visits: list[Visit] = []

    def open_page(address: str, token: str = "", path: str = "", **options: Any) -> Visit:
        usual: dict[str, Any] = {"viewport": SMALL, "reduced_motion": "reduce", "color_scheme": "light"}
        context = chromium.new_context(**(usual | options))
        contexts.append(context)
        if token:
            context.add_cookies([{"name": "sonarpost_session", "value": token, "url": address}])
        visits.append(Visit(context, address))
        visits[-1].page.goto(address + path)
        if token and not path:
            # Keys count from the moment at which the page has loaded its list.
            visits[-1].until("() => /of/.test(document.querySelector('.filters .sum')?.textContent)")
        return visits[-1]

    yield open_page
    for one in visits:
        one.check()
    for context in contexts:
        context.close()


class Served:
    """A console's page on a port, without Zenoh: what arrives is put onto its board by the test."""

    def __init__(self, console: Any, visit: Callable[..., Visit]) -> None:
        self.console = console
        self.board = console.board
        self.users: Users = console.users
        self._visit = visit
        self._app = console.app
        self._server = WebServer(self._app.asgi, "127.0.0.1", 0)
        self._server.start()
        self.address = self._server.address

    def visit(self, user: str = "anna", **options: Any) -> Visit:
        """Open the page as somebody who has logged in."""
        return self._visit(self.address, self.users.begin(user).token if user else "", **options)

    def stop(self) -> None:
        self._app.end()
        self._server.stop()

    def start_again(self) -> None:
        """Serve on the same port as before."""
        port = urlsplit(self.address).port
        assert port is not None
        self._app = ConsoleApp(self.board, self.users, "vessel-1")
        self._server = WebServer(self._app.asgi, "127.0.0.1", port)
        self._server.start()


@pytest.fixture
def serve(make_console: Callable[..., Any], visit: Callable[..., Visit]) -> Iterator[Callable[..., Served]]:
    """Serves consoles."""
    served: list[Served] = []

    def start(**options: Any) -> Served:
        served.append(Served(make_console(port=0, **options), visit))
        return served[-1]

    yield start
    for one in served:
        one.stop()


@pytest.fixture
def served(serve: Callable[..., Served]) -> Served:
    return serve()
