"""`python -m research.console_screen`: time to draw the console's list and new images, with thousands of contacts.

    python -m research.console_screen --contacts 5000

Runs the service with an in-process Zenoh router and simulated contacts, and opens the page in Debian's Chromium. Images
are published as the decompressor does. A time ends with the animation frame after the change is drawn. Both clocks are
those of this host.
"""

import argparse
import os
import shutil
import time
from contextlib import closing
from urllib.parse import urlsplit

import zenoh
from playwright.sync_api import Page, sync_playwright

from research.console_scale import filled_console, show
from sonarpost import keys, wire
from sonarpost.bus.session import client_config
from sonarpost.extensions.training.contacts import simulated_contacts
from sonarpost.extensions.training.simulator import VESSEL
from sonarpost.messages import ReconstructedImage
from sonarpost.services.console.web.access import COOKIE, cookie_name

# Time of the first row, in ms since the start of the navigation; time of an awaited change, in ms since 1970.
WATCH = """() => {
  window.firstRow_ms = null;
  const drawn = () => performance.timeOrigin + performance.now();
  new MutationObserver((_, observer) => {
    if (!document.querySelector('.row')) return;
    observer.disconnect();
    requestAnimationFrame(() => setTimeout(() => { window.firstRow_ms = performance.now(); }));
  }).observe(document, {childList: true, subtree: true});
  window.whenDrawn = (test, argument) => new Promise(resolve => {
    const is = new Function('argument', `return ${test}`);
    const done = () => requestAnimationFrame(() => setTimeout(() => resolve(drawn())));
    if (is(argument)) return done();
    new MutationObserver((_, observer) => {
      if (!is(argument)) return;
      observer.disconnect();
      done();
    }).observe(document.body, {childList: true, subtree: true, attributes: true});
  });
}"""
ROW = "document.querySelector('.row[data-id*=\".' + argument + '\"]')"
TO_TOP = "document.getElementById('queue').scrollTop = 0"  # the list keeps the selected row in sight
IMAGE = "document.querySelector('canvas').dataset.shows?.includes(argument)"


def main() -> None:
    """Measure and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--contacts", type=int, default=5000)
    parser.add_argument("--changes", type=int, default=50, help="number of new contacts and of new versions")
    parsed = parser.parse_args()
    chromium = os.environ.get("SONARPOST_CHROMIUM") or shutil.which("chromium")
    if chromium is None:
        raise SystemExit("no Chromium: apt-get install chromium, or set SONARPOST_CHROMIUM")
    with filled_console(parsed.contacts) as (address, endpoint, users), sync_playwright() as playwright:
        arguments = ["--enable-precise-memory-info", *(["--no-sandbox"] if os.geteuid() == 0 else [])]
        browser = playwright.chromium.launch(executable_path=chromium, args=arguments)
        context = browser.new_context(viewport={"width": 1366, "height": 768})
        token = users.start_session("bench").token
        context.add_cookies([{"name": cookie_name(COOKIE, urlsplit(address).netloc), "value": token, "url": address}])
        page = context.new_page()
        page.add_init_script(f"({WATCH})()")
        with closing(browser), zenoh.open(client_config([endpoint])) as session:
            measure(page, address, session, parsed.changes)


def measure(page: Page, address: str, session: zenoh.Session, changes: int) -> None:
    """Open the page ten times, then publish new contacts and newer versions."""
    opened = []
    for _ in range(10):
        page.goto(address)
        page.wait_for_function("() => window.firstRow_ms !== null")
        opened.append(float(page.evaluate("window.firstRow_ms")) / 1000)
    show("page opened to list drawn", opened)
    page.wait_for_function("() => document.body.dataset.online === 'true'")
    simulated = next(simulated_contacts(7, time.time()))
    first = simulated.record(VESSEL, 0, time.time(), time.time())
    rows, images = [], []
    for number in range(changes):
        image_id = f"Z{number:03d}"
        record = first.model_copy(update={"image_id": image_id, "first_frame_utc_s": time.time()})
        page.evaluate(TO_TOP)
        rows.append(published_to(page, session, record, ROW, image_id))
    page.evaluate(TO_TOP)
    page.click(f".row[data-id*='.{image_id}']")
    page.wait_for_function("id => document.querySelector('canvas').dataset.shows?.includes(id)", arg=image_id)
    for version in range(2, changes + 2):
        newer = record.model_copy(update={"version": version, "last_frame_utc_s": time.time()})
        images.append(published_to(page, session, newer, IMAGE, f" {version} raw"))
    show("publish the image of a new contact until its row is drawn", rows)
    show("publish a newer image of the shown contact until it is drawn", images)
    page.evaluate("""async () => {
      const list = document.getElementById('queue');
      for (let at = 0; at < list.scrollHeight; at += 20000) {
        list.scrollTop = at;
        await new Promise(resolve => setTimeout(resolve, 30));
      }
    }""")
    page.wait_for_selector(".row")
    heap_mb = page.evaluate("performance.memory.usedJSHeapSize") / 2**20
    total = page.evaluate("Number(document.querySelector('.row')?.ariaSetSize)")
    print(
        f"after scrolling through {total} rows: {page.locator('.row').count()} row elements, {heap_mb:.1f} MB of heap"
    )


def published_to(page: Page, session: zenoh.Session, record: ReconstructedImage, test: str, argument: str) -> float:
    """Publish an image; return the time until its change is drawn."""
    payload = wire.encode(record)
    handle = page.evaluate_handle("([test, argument]) => ({drawn: window.whenDrawn(test, argument)})", [test, argument])
    started_s = time.time()
    session.put(keys.image_reconstructed(VESSEL), payload, encoding=wire.encoding_of(ReconstructedImage))
    return float(handle.evaluate("one => one.drawn")) / 1000 - started_s


if __name__ == "__main__":
    main()
