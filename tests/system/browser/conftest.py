"""A console page in Chromium and in Firefox, driven by Playwright. Requests to other hosts fail the test."""

import os
import shutil
from collections.abc import Callable, Iterator
from typing import Any
from urllib.parse import urlsplit

import httpx2
import pytest
from builders.common import WAIT_S
from builders.console import Browser as HttpBrowser
from builders.console import (
    Console,
    console,
    contact_ids,
    fast_password_hashes,
    make_console,
    session_cookie,
    users_file,
)
from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, Playwright, Request, sync_playwright

from sonarpost.services.console.web.server import ConsoleApp, WebServer

__all__ = ["console", "fast_password_hashes", "make_console", "users_file"]

SMALL = {"width": 1366, "height": 768}
TIMEOUT_MS = 1000 * WAIT_S
COMMANDS = {"chromium": ("chromium",), "firefox": ("firefox", "firefox-esr")}
"""Commands of a browser; the last one is the name of its Debian package."""
BROWSER_MESSAGES = (
    # Firefox reports the end of an event stream, for example when the page is closed.
    "/events?last=",
    "was interrupted while the page was loading",
    # Playwright adds a style to the page for screenshots in Firefox; the page's policy refuses it.
    "an inline style (style-src-elem)",
    # Chromium fetches the service worker when a test has stopped the server.
    "An unknown error occurred when fetching the script.",
)
"""Parts of messages of browsers that are no errors of the page."""


class Browsers:
    """Playwright and its browsers: started at their first use, closed after the last test of this folder in a row."""

    def __init__(self) -> None:
        self._playwright: Playwright | None = None
        self._browsers: dict[str, Browser] = {}

    def get(self, name: str) -> Browser:
        if name not in self._browsers:
            self._playwright = self._playwright or sync_playwright().start()
            self._browsers[name] = self._launch(self._playwright, name)
        return self._browsers[name]

    def _launch(self, playwright: Playwright, name: str) -> Browser:
        found = (shutil.which(command) for command in COMMANDS[name])
        chosen = os.environ.get(f"SONARPOST_{name.upper()}")
        path = chosen if chosen not in (None, "", "all") else next(filter(None, found), None)
        if path is None:
            pytest.skip(f"no {name}: apt-get install {COMMANDS[name][-1]}, or set SONARPOST_{name.upper()}")
        if name == "firefox":
            preferences = {"widget.gtk.overlay-scrollbars.enabled": False, "ui.useOverlayScrollbars": 0}
            return playwright.firefox.launch(
                channel="moz-firefox", executable_path=path, firefox_user_prefs=preferences, timeout=TIMEOUT_MS
            )
        # Chromium's sandbox does not run as root, for example in containers.
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        # Only the local host can be resolved.
        arguments += ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"]
        # Scroll bars take space, as in the browsers of operators.
        hidden = ["--hide-scrollbars"]
        return playwright.chromium.launch(
            executable_path=path, args=arguments, ignore_default_args=hidden, timeout=TIMEOUT_MS
        )

    def close(self) -> None:
        for browser in self._browsers.values():
            browser.close()
        self._browsers = {}
        if self._playwright is not None:
            # Until then, its event loop runs in this thread, and other tests cannot start one.
            self._playwright.stop()
        self._playwright = None


BROWSERS = Browsers()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    """Close the browsers before a test of another folder."""
    yield
    if nextitem is None or nextitem.path.parent != item.path.parent:
        BROWSERS.close()


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "firefox: runs in Firefox too; with SONARPOST_FIREFOX=all, every test does")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what does not run in Firefox: tests that cannot, and those without the mark `firefox`."""

    def is_left_out(item: pytest.Item) -> bool:
        parameters = getattr(item, "callspec", None)
        if parameters is None or parameters.params.get("browser") != "firefox":
            return False
        if item.get_closest_marker("chromium_only") is not None:
            return True
        return os.environ.get("SONARPOST_FIREFOX") != "all" and item.get_closest_marker("firefox") is None

    left_out = [item for item in items if is_left_out(item)]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if not is_left_out(item)]


@pytest.fixture(params=["chromium", "firefox"])
def browser(request: pytest.FixtureRequest) -> Browser:
    return BROWSERS.get(request.param)


class Visit:
    """An open page. It records script errors and requests to other hosts."""

    def __init__(self, context: BrowserContext, address: str) -> None:
        self.address = address
        self.foreign_requests: list[str] = []
        self.errors: list[str] = []
        self.expected_errors: tuple[str, ...] = ()
        self.page: Page = context.new_page()
        self.page.set_default_timeout(TIMEOUT_MS)
        self.page.on("pageerror", lambda error: self.errors.append(f"script: {error}"))
        self.page.on("console", self._on_console)
        self.page.on("request", self._on_request)

    def _on_console(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self.errors.append(f"{message.text} ({message.location.get('url', '')})")

    def _on_request(self, request: Request) -> None:
        if urlsplit(request.url).netloc != urlsplit(self.address).netloc and not request.url.startswith(
            ("blob:", "data:")
        ):
            self.foreign_requests.append(request.url)

    def load(self, address: str) -> None:
        """Load a page; again if an interface of the machine has changed, for example by containers of other tests."""
        self.page.goto(address)
        while any("ERR_NETWORK_CHANGED" in error for error in self.errors):
            self.errors.clear()
            self.page.goto("about:blank")
            self.page.goto(address)

    def expect_errors(self, *parts: str) -> None:
        """Accept errors on the browser's console that contain one of these texts."""
        self.expected_errors += parts

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)

    def decide(self, key: str) -> None:
        """Press a verdict key after the image has been in sight for the time from which verdicts count."""
        self.wait(".decision[data-ready=true]")
        self.press(key)

    def open_dialog(self, name: str) -> None:
        """Open a dialog by its item of the menu in the header, or by its key."""
        if len(name) == 1:
            self.press(name)
        else:
            self.page.locator(f"#bar [data-item={name}]").dispatch_event("click")
        self.wait("dialog[open]")

    def set_appearance(self, *, theme: str = "", size: str = "") -> None:
        """Set theme (`day`, `night`) and type size (`normal`, `large`) as the menu of the header does."""
        self.page.evaluate(
            """async ([theme, size]) => {
              const { setTheme, setTypeSize } = await import('/static/js/shell/header.js');
              if (theme) setTheme(theme);
              if (size) setTypeSize(size);
            }""",
            [theme, size],
        )

    def text(self, selector: str) -> str:
        return self.page.locator(selector).first.inner_text()

    def wait(self, selector: str, **options: Any) -> Any:
        return self.page.wait_for_selector(selector, **options)

    def until(self, expression: str, argument: Any = None) -> None:
        """Wait until a JavaScript expression is true."""
        self.page.wait_for_function(expression, arg=argument)

    def wait_for_contact(self, image_id: str) -> None:
        """Wait until a contact and its image are displayed."""
        self.until("id => document.querySelector('.heading h2')?.textContent.endsWith(id)", image_id)
        self.until("id => document.querySelector('canvas').dataset.shows?.includes(`.${id} `)", image_id)

    def resize(self, width: int, height: int) -> None:
        self.page.set_viewport_size({"width": width, "height": height})
        self.until("width => innerWidth === width", width)
        self.settle()

    def settle(self) -> None:
        """Wait for two frames, in which the observers of sizes are called."""
        self.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")

    def is_firefox(self) -> bool:
        browser = self.page.context.browser
        return browser is not None and browser.browser_type.name == "firefox"

    def pixels(self, selector: str = ".stage canvas") -> int:
        """Return how many pixels of a canvas differ from its first one."""
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
        """Fail after an unexpected error, or a request to another host."""
        accepted = (*self.expected_errors, *BROWSER_MESSAGES)
        unexpected = [error for error in self.errors if not any(part in error for part in accepted)]
        assert unexpected == []
        assert self.foreign_requests == []


Visitor = Callable[..., Visit]


@pytest.fixture
def visit(browser: Browser) -> Iterator[Callable[..., Visit]]:
    """Opens pages of a console with `visit(address, token)`, and checks them after the test."""
    contexts: list[BrowserContext] = []
    visits: list[Visit] = []

    def open_page(address: str, token: str = "", path: str = "", **options: Any) -> Visit:
        defaults: dict[str, Any] = {"viewport": SMALL, "reduced_motion": "reduce", "color_scheme": "light"}
        context = browser.new_context(**(defaults | options))
        contexts.append(context)
        if token:
            context.add_cookies([{"name": session_cookie(address), "value": token, "url": address}])
        visits.append(Visit(context, address))
        visits[-1].load(address + path)
        if token and not path:
            # The page accepts keys after it has loaded the list.
            visits[-1].until("() => /[0-9]/.test(document.querySelector('.filters .sum')?.textContent)")
        return visits[-1]

    yield open_page
    for one in visits:
        one.check()
    for context in contexts:
        context.close()


class Served:
    """A web server with a console, without Zenoh. Tests store records in its state."""

    def __init__(self, console: Console, visit: Callable[..., Visit]) -> None:
        self.console = console
        self.state = console.state
        self.users = console.users
        self._visit = visit
        self._clients: list[httpx2.Client] = []
        self._app = console.app
        self._server = WebServer(self._app.asgi, "127.0.0.1", 0)
        self._server.start()
        self.address = self._server.address

    def visit(self, user: str = "anna", **options: Any) -> Visit:
        """Open the page with a session of a user; without a session for an empty name."""
        return self._visit(self.address, self.users.start_session(user).token if user else "", **options)

    def client(self, user: str) -> HttpBrowser:
        """A logged-in client of the server. One in this process (`Console.browser`) would have another event loop."""
        self._clients.append(httpx2.Client(base_url=self.address, timeout=WAIT_S))
        client = HttpBrowser(self._clients[-1])
        assert client.login(user).status_code == 200
        return client

    def contact(self, image_id: str = "00A7") -> Any:
        """The contact of an image, with its decisions, measurements and requests."""
        return self.state.contact_detail(contact_ids(self.state)[image_id])

    def decisions(self, image_id: str) -> Any:
        return self.contact(image_id)["decisions"]

    def sent(self, kind: type) -> list[Any]:
        """Records of a kind that wait to be sent."""
        return [item.record for item in self.state.unsent_records() if isinstance(item.record, kind)]

    def stop(self) -> None:
        for client in self._clients:
            client.close()
        self._app.stop()
        self._server.stop()

    def restart(self) -> None:
        """Start a new server on the same port."""
        port = urlsplit(self.address).port
        assert port is not None
        self._app = ConsoleApp(self.state, self.users, "vessel-1")
        self._server = WebServer(self._app.asgi, "127.0.0.1", port)
        self._server.start()


@pytest.fixture
def serve(make_console: Callable[..., Any], visit: Callable[..., Visit]) -> Iterator[Callable[..., Served]]:
    """Starts web servers with consoles."""
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
