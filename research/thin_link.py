"""Bytes between the routers of a vessel and a shore site, by the settings of the routers.

    python -m research.thin_link [--images 60] [--seconds 60]

Two routers with the configurations of `sonarpost pki router-config` are linked by TLS through a link that
counts the bytes of each direction. The vessel's services (op_modem, decompressor, relay, console) publish their health
at the default interval, and a subscriber at the shore's router receives it, as `sonarpost status` does. For each
setting there are two periods of `--seconds`: without contacts, and with `--images` coded images of 200 bytes, which the
relay delivers to a c2 that only commits records. Printed are

- the bytes a minute without contacts, from and to the vessel;
- the additional bytes of each contact, from and to the vessel, and the contacts that c2 has acknowledged;
- the health reports received at the shore's and at the vessel's router, and the longest time between two reports of
  one service at the shore's router.

Headers of TCP and IP are not included. The exit status is 0 if c2 has acknowledged every contact.
"""

import argparse
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path, PurePosixPath

import zenoh
from typing_extensions import override

from research.common.link_emulator import LinkEmulator
from research.common.ports import free_ports
from research.fleet import Processes, coded_image, open_session, wait_until_alive
from research.relay_throughput import Sink
from sonarpost import keys
from sonarpost.bus import router
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.delivery.client import deliver
from sonarpost.messages import ImagePart, Record
from sonarpost.runtime.service import UnitOfWork
from sonarpost.security.fleet import Fleet
from sonarpost.security.router_config import RouterOptions, router_json5
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

VESSEL, SHORE = "vessel-1", "shore-1"
PROCESSES = ("op_modem", "decompressor", "console")
SERVICES = ("router", "relay", *PROCESSES)
STREAM_BYTES = 200
START_TIMEOUT_S = 600.0
SETTLE_S = 12.0


@dataclass(frozen=True)
class Setting:
    """Name, `--thin-link` of both routers, and Zenoh settings of both routers (`KEY:VALUE`)."""

    name: str
    thin: bool = False
    options: tuple[str, ...] = ()


COMPRESSION = "transport/unicast/compression/enabled:"
SETTINGS = (
    Setting("default"),
    Setting("compression", options=(f"{COMPRESSION}true",)),
    Setting("downsampling", thin=True, options=(f"{COMPRESSION}false",)),
    Setting("thin link: both", thin=True),
)
COLUMNS = ("idle up", "idle down", "contact up", "down", "contacts", "at shore", "at vessel", "longest s")


def print_row(name: str, cells: Sequence[str]) -> None:
    """Print one row of a table."""
    print(f"{name:24}" + "".join(f"{cell:>14}" for cell in cells), flush=True)


class HealthTimes:
    """Arrival times of the health reports of the vessel's services, by service."""

    def __init__(self, session: zenoh.Session) -> None:
        self.arrivals: dict[str, list[float]] = {name: [] for name in SERVICES}
        session.declare_subscriber(keys.health_all(VESSEL), self._on_sample)

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self.arrivals.setdefault(keys.service_of(str(sample.key_expr))[1], []).append(time.monotonic())

    def longest_gap_s(self, start_s: float) -> float:
        """Return the longest time between two reports of one service since `start_s`, the present time included."""
        now_s = time.monotonic()
        times = [[start_s, *(at_s for at_s in found if at_s > start_s), now_s] for found in self.arrivals.values()]
        return max(later - earlier for found in times for earlier, later in pairwise(found))


class Shore(Sink):
    """A c2 that commits and counts images: its decoder would use the cores of the measurement."""

    def __init__(self, platform: PlatformConfig, config: ServiceConfig) -> None:
        super().__init__(platform, config)
        self.images: set[str] = set()

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Count an image."""
        if isinstance(record, ImagePart):
            self.images.add(record.i)


@dataclass
class Sites:
    """The link, c2, the relay, sessions at the vessel's and the shore's router."""

    link: LinkEmulator
    c2: Shore
    relay: RelayService
    vessel: zenoh.Session
    shore: zenoh.Session


@contextmanager
def linked_sites(folder: Path, setting: Setting) -> Iterator[Sites]:
    """Start routers and services."""
    shore_tls, shore_local, vessel_local, modem = free_ports(4)
    link = LinkEmulator(shore_tls)
    fleet = Fleet.init(folder / "pki", "thin")
    shore_files = PurePosixPath(fleet.issue(SHORE, "shore", ["localhost"]).folder)
    vessel_files = PurePosixPath(fleet.issue(VESSEL, "vessel").folder)
    ends = {SHORE: f"tcp/127.0.0.1:{shore_local}", VESSEL: f"tcp/127.0.0.1:{vessel_local}"}
    all_options = (
        RouterOptions(
            SHORE,
            listen=[f"tls/localhost:{shore_tls}"],
            local=[ends[SHORE]],
            files=shore_files,
            thin_link=setting.thin,
        ),
        RouterOptions(
            VESSEL,
            local=[ends[VESSEL]],
            connect=[f"tls/localhost:{link.port}"],
            files=vessel_files,
            thin_link=setting.thin,
        ),
    )
    file = folder / "vessel.toml"
    file.write_text(
        f'[platform]\nid = "{VESSEL}"\nrouter = ["{ends[VESSEL]}"]\nstate_dir = "{folder}/vessel"\n'
        f'acoustic_auth = "none"\n[modem]\ndriver = "udp"\n[op_modem]\nport = "udp://239.255.7.1:{modem}"\n'
        f'address = 1\nvehicles = {{ 3 = "uuv-1" }}\n[decompressor]\nout_dir = "{folder}/images"\n'
        "[console]\nport = 0\n"
    )
    with ExitStack() as stack:
        stack.callback(link.close)
        for options in all_options:
            path = folder / f"{options.platform}.json5"
            path.write_text(router_json5(fleet.index(), options, time.time()))
            config = router.load(path, (), (), setting.options)
            monitor = router.RouterMonitor(config)
            monitor.start(stack.enter_context(zenoh.open(config)))
            stack.callback(monitor.close)
        processes = Processes(folder)
        stack.callback(processes.stop)
        for service in PROCESSES:
            processes.start(service, "-m", f"sonarpost.services.{service}", "--config", str(file))
        c2 = Shore(PlatformConfig(id=SHORE, router=(ends[SHORE],), state_dir=folder / SHORE), ServiceConfig())
        relay = RelayService(
            PlatformConfig(id=VESSEL, router=(ends[VESSEL],), state_dir=folder / VESSEL), RelayConfig()
        )
        for one in (c2, relay):
            one.start()
            stack.callback(one.stop)
        vessel, shore = (stack.enter_context(open_session(ends[name])) for name in (VESSEL, SHORE))
        wait_until_alive(shore, {keys.alive(VESSEL, name) for name in SERVICES}, START_TIMEOUT_S)
        yield Sites(link, c2, relay, vessel, shore)


def measure(folder: Path, setting: Setting, images: int, seconds: float) -> bool:
    """Print the bytes of one setting; return whether all images were acknowledged."""
    with linked_sites(folder, setting) as sites:
        at_shore, at_vessel = HealthTimes(sites.shore), HealthTimes(sites.vessel)
        time.sleep(SETTLE_S)
        started_s = time.monotonic()
        before = tuple(sites.link.passed_bytes.values())
        time.sleep(seconds)
        middle_s, middle = time.monotonic(), tuple(sites.link.passed_bytes.values())
        for n in range(images):
            stream = random.Random(n).randbytes(STREAM_BYTES)  # a coded stream is not compressible either
            image = coded_image(VESSEL, 1, n, time.time(), stream)
            deliver(sites.vessel, keys.image_coded(VESSEL), "relay", image, START_TIMEOUT_S)
            time.sleep(max(0.0, middle_s + (n + 1) * seconds / images - time.monotonic()))
        ends_s = time.monotonic() + START_TIMEOUT_S
        while sites.relay.store.inbox_depth() + sites.relay.store.outbox_depth() and time.monotonic() < ends_s:
            time.sleep(0.1)
        ended_s, after = time.monotonic(), tuple(sites.link.passed_bytes.values())
        reports = [sum(map(len, times.arrivals.values())) for times in (at_shore, at_vessel)]
        gap_s = at_shore.longest_gap_s(started_s)
        accepted = len(sites.c2.images)
    idle_per_s = [(middle[n] - before[n]) / (middle_s - started_s) for n in (0, 1)]
    contact = [(after[n] - middle[n] - idle_per_s[n] * (ended_s - middle_s)) / images for n in (0, 1)]
    cells = [f"{60 * value:.0f}" for value in idle_per_s] + [f"{value:.0f}" for value in contact]
    cells += [f"{accepted} of {images}", *map(str, reports), f"{gap_s:.1f}"]
    print_row(setting.name, cells)
    return accepted == images


def main() -> int:
    """Run; return 1 if an image was not acknowledged."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=60, metavar="N", help="coded images of a period; default: 60")
    parser.add_argument("--seconds", type=float, default=60.0, metavar="S", help="each period; default: 60")
    parser.add_argument("--only", choices=[setting.name for setting in SETTINGS], help="measure one setting")
    args = parser.parse_args()
    print_row("", COLUMNS)
    passed = True
    for setting in SETTINGS:
        if args.only in (None, setting.name):
            with ProgressDisplay(step=setting.name), tempfile.TemporaryDirectory() as name:
                passed &= measure(Path(name), setting, args.images, args.seconds)
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
