"""`python -m research.console_scale`: the console with thousands of contacts: time for lists and events, memory.

    python -m research.console_scale --contacts 5000

Runs the service with an in-process Zenoh router and simulated contacts. A client requests lists by HTTP and follows the
event stream while new versions of images are published, as the decompressor does.
The time to draw the page is not included: `python -m research.console_screen` measures it.
"""

import argparse
import json
import statistics
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from http.client import HTTPResponse
from pathlib import Path

import zenoh

from research.common.ports import free_ports
from sonarpost import keys, wire
from sonarpost.bus.session import client_config, router_config
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.config import PlatformConfig
from sonarpost.extensions.training.contacts import simulated_contacts
from sonarpost.extensions.training.simulator import VESSEL, TrainingSimulator
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.service import ConsoleService
from sonarpost.services.console.store.users import FILE_NAME, Users

PASSWORD = "a password for the benchmark"
LISTS = (
    "limit=100",
    "limit=500",
    "sort=confidence&limit=100&offset=2500",
    "review=unreviewed&sort=arrived&order=asc&limit=100",
    "q=00A&limit=100",
)


def main() -> None:
    """Measure and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--contacts", type=int, default=5000)
    parser.add_argument("--versions", type=int, default=200, help="number of new versions, published one after another")
    parsed = parser.parse_args()
    with filled_console(parsed.contacts) as (address, endpoint, _):
        browser = Browser(address)
        for query in LISTS:
            show(f"list {query}", [browser.timed(f"api/contacts?{query}") for _ in range(50)])
        show("map", [browser.timed("api/map") for _ in range(20)])
        show("KMZ of all contacts", [browser.timed("api/export/contacts.kmz")])
        before_mb = resident_mb()
        show("published to event", latencies(endpoint, browser, parsed.versions))
        print(
            f"memory: {before_mb:.0f} MB before, {resident_mb():.0f} MB after {parsed.versions} versions and the lists"
        )


@contextmanager
def filled_console(contacts: int) -> Iterator[tuple[str, str, Users]]:
    """Run a router and the service with simulated contacts.

    Yields:
        The address of the page, the endpoint of the router, and the users, of which `bench` has `PASSWORD`.
    """
    endpoint = f"tcp/127.0.0.1:{free_ports(1)[0]}"
    with tempfile.TemporaryDirectory(prefix="sonarpost-bench-") as folder, zenoh.open(router_config([endpoint])):
        platform = PlatformConfig(id=VESSEL, router=(endpoint,), state_dir=Path(folder))
        with closing(Users(Path(folder) / FILE_NAME)) as users:
            users.add("bench", "operator", PASSWORD)
            service = ConsoleService(platform, ConsoleConfig(port=0))
            assert service.start()
            try:
                empty_mb = resident_mb()
                started_s = time.perf_counter()
                TrainingSimulator(service.state, contacts).load_backlog(contacts)
                print(f"{contacts} contacts in {time.perf_counter() - started_s:.0f} s")
                print(
                    f"memory: {empty_mb:.0f} MB empty, {resident_mb():.0f} MB filled (codecs and simulation included)"
                )
                yield service.address, endpoint, users
            finally:
                service.stop()


class Browser:
    """A logged-in client."""

    def __init__(self, address: str) -> None:
        self._address = address
        body = json.dumps({"user": "bench", "password": PASSWORD}).encode()
        with urllib.request.urlopen(address + "api/login", body, timeout=10) as answer:
            self._headers = {"Cookie": answer.headers["set-cookie"].partition(";")[0]}

    def open(self, path: str) -> HTTPResponse:
        """Send a request."""
        request = urllib.request.Request(self._address + path, None, self._headers)
        found: HTTPResponse = urllib.request.urlopen(request, timeout=600)
        return found

    def timed(self, path: str) -> float:
        """Return the time of a complete response in seconds."""
        started_s = time.perf_counter()
        with self.open(path) as answer:
            answer.read()
        return time.perf_counter() - started_s


def latencies(endpoint: str, browser: Browser, versions: int) -> list[float]:
    """Return the times from the publication of an image to its event in the stream, in seconds."""
    arrived: dict[str, float] = {}
    changed = threading.Condition()
    stream = browser.open("events")

    def follow() -> None:
        try:
            for line in stream:
                if line.startswith(b'data: {"contact":'):
                    now = time.perf_counter()
                    contact = json.loads(line[6:])["contact"]
                    with changed:
                        arrived[contact["image_id"]] = now
                        changed.notify()
        except (OSError, ValueError, AttributeError):
            return  # closed

    threading.Thread(target=follow, daemon=True).start()
    simulated = next(simulated_contacts(7, time.time()))
    found = []
    with zenoh.open(client_config([endpoint])) as session:
        for number in range(versions):
            record = simulated.record(VESSEL, 0, time.time(), time.time())
            image_id = f"Z{number:03d}"
            payload = wire.encode(record.model_copy(update={"image_id": image_id}))
            started_s = time.perf_counter()
            session.put(keys.image_reconstructed(VESSEL), payload, encoding=wire.encoding_of(type(record)))
            with changed:
                assert changed.wait_for(partial(arrived.__contains__, image_id), timeout=30), image_id
            found.append(arrived[image_id] - started_s)
    stream.close()
    return found


def resident_mb() -> float:
    """Return the resident memory of this process in MB."""
    [line] = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmRSS:")]
    return int(line.split()[1]) / 1024


def show(name: str, times_s: Sequence[float]) -> None:
    """Print median, 95th percentile and maximum."""
    ordered = sorted(1e3 * at for at in times_s)
    slow_ms = ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))]
    print(f"{name}: p50 {statistics.median(ordered):.1f} ms, p95 {slow_ms:.1f} ms, most {ordered[-1]:.1f} ms")


if __name__ == "__main__":
    with ProgressDisplay(step="console_scale"):
        main()
