"""Settings of a chain on one host, and the configuration files written from them."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from random import SystemRandom
from typing import Literal

from sonarpost.errors import PortError
from sonarpost.modem.interface import RateInfo
from sonarpost.modem.registry import DEFAULT_DRIVER, modem_driver

ROUTER_PORTS = (7467, 7457, 7447)
"""Ports of the routers of a demo's vehicle, vessel and shore site, if they are free. 7447 is Zenoh's usual port."""
CONSOLE_PORT = 8470
FREE_PORTS = (10_000, 32_000)
"""Range of `free_ports`: below the ports of outgoing connections, which could take one while no router listens."""
UUV, VESSEL, SHORE, WATER = "uuv-1", "vessel-1", "shore-1", "water"
UUV_ADDRESS, VESSEL_ADDRESS = 3, 1
PLATFORM_OF = {
    "atd_stub": UUV,
    "compressor": UUV,
    "uuv_modem": UUV,
    "acoustic_channel": WATER,
    "op_modem": VESSEL,
    "decompressor": VESSEL,
    "relay": VESSEL,
    "c2": SHORE,
}
HEALTH_INTERVAL_S = 0.25
STATUS_PERIOD_S = 60.0
"""Time between two statuses of the vehicle in the channel: 25 of 1900 B at rate 1."""
MIN_STATUS_PERIOD_S = 5.0
"""The least one that uuv_modem accepts, in real time."""
STREAM_BYTES = 200
"""Stream length with v1: what the paper's codec makes of 140 x 80 px, so that both can be compared."""


@dataclass(frozen=True)
class ChainSettings:
    """Settings of a chain of processes on one host.

    Attributes:
        folder: Folder of everything that the chain writes.
        mode: As in [atd_stub].
        link: Wire format: "v1" with the codec emb, or the paper's with its tile codec.
        modem: Name of the modem driver.
        rate: Rate of the modem.
        loss: Probability that a frame is lost.
        seed: Seed of the channel simulator.
        time_scale: Simulated seconds in the channel for each real second.
        codebook: Codebook of the vehicle, for the paper's codec.
        vessel_codebooks: Codebooks of the vessel.
        router_ports: TCP ports of the routers of the vehicle, the vessel and the shore site.
        shore_port_for_vessel: Port at which the vessel's router connects to the shore site, if not the shore router's
            own: a test puts a connection there that it can cut.
        console_port: Port of the operator's page on the vessel; None for no page.
        extra: Additional lines for the table of a service, by service.
    """

    folder: Path
    mode: Literal["survey", "snippets"] = "survey"
    link: Literal["v1", "paper"] = "v1"
    modem: str = DEFAULT_DRIVER
    rate: int = 1
    loss: float = 0.0
    seed: int = 1
    time_scale: float = 20.0
    codebook: str = "nominal-10"
    vessel_codebooks: tuple[str, ...] = ("nominal-10", "nominal-20")
    router_ports: tuple[int, int, int] = (0, 0, 0)
    shore_port_for_vessel: int = 0
    console_port: int | None = None
    extra: tuple[tuple[str, str], ...] = ()

    @property
    def incoming(self) -> Path:
        """Input folder of atd_stub."""
        return self.folder / "uuv" / "incoming"

    @property
    def vessel_images(self) -> Path:
        """Output folder of the decompressor."""
        return self.folder / "vessel" / "images"

    @property
    def shore_images(self) -> Path:
        """Folder in which c2 stores the images of this vessel."""
        return self.folder / "shore" / "images" / VESSEL

    @property
    def channel_log(self) -> Path:
        """Log of the simulated channel: the fate of every packet."""
        return self.folder / "water" / "channel.jsonl"

    @property
    def rate_info(self) -> RateInfo:
        """The rate of the modem."""
        return modem_driver(self.modem).capabilities.rates[self.rate]

    @property
    def packet_s(self) -> float:
        """Real duration of a packet."""
        return self.rate_info.airtime_s / self.time_scale

    @property
    def pairing_timeout_s(self) -> float:
        """Real time the paper's receiver waits for the rest of an image: four packets and 3 s for a loaded host."""
        return 4 * self.packet_s + 3.0

    @property
    def feedback_interval_s(self) -> float:
        """Real time between two feedback messages of the vessel, with v1."""
        return 20.0 / self.time_scale + 0.5

    @property
    def reply_timeout_s(self) -> float:
        """Real time the drivers wait for a reply, with v1: a modem that receives replies at the end of the packet."""
        return 5.0 / self.time_scale + 1.0

    @property
    def ports_folder(self) -> Path:
        """Folder of the emulated modems' pseudo-terminals."""
        return self.folder / "water" / "ports"

    def modem_port(self, address: int) -> Path:
        """Path of the pseudo-terminal of an emulated modem; the emulator numbers them in the order of its table."""
        return self.ports_folder / f"modem-{(UUV_ADDRESS, VESSEL_ADDRESS).index(address) + 1}"

    def config_file(self, service: str) -> Path:
        """Return the configuration file of a service; the optional console belongs to the vessel."""
        return self.folder / "config" / f"{PLATFORM_OF.get(service, VESSEL)}.toml"


def free_ports(count: int) -> tuple[int, ...]:
    """Return different random TCP ports of `FREE_PORTS` that are free now."""
    # Seeded by the system: another process with the same seed would take the same ports.
    random, found = SystemRandom(), set[int]()
    while len(found) < count:
        port = random.randrange(*FREE_PORTS)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            found.add(port)
    return tuple(found)


@contextmanager
def reserved_ports(*preferred: int) -> Iterator[tuple[int, ...]]:
    """Reserve a TCP port for each preferred one: itself, or else the next one that is free.

    The reservation excludes other demos on this host.

    Raises:
        PortError: No port is free.
    """
    with ExitStack() as stack:
        yield tuple(_reserve(port, stack) for port in preferred)


def _reserve(preferred: int, stack: ExitStack) -> int:
    for port in range(preferred, 65536):
        # The probe of the port itself is closed again: a router must be able to listen. This name stays reserved.
        reservation = socket.socket(socket.AF_UNIX)
        try:
            reservation.bind(f"\0sonarpost-demo-{port}")
            with socket.socket() as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(("127.0.0.1", port))
        except OSError:
            reservation.close()
            continue
        stack.enter_context(reservation)
        return port
    raise PortError(f"no free TCP port from {preferred} on")


def write_config(settings: ChainSettings) -> None:
    """Write one TOML file for each platform."""
    folder = settings.folder / "config"
    folder.mkdir(parents=True, exist_ok=True)
    uuv_port, vessel_port, shore_port = settings.router_ports
    ports = {UUV: uuv_port, VESSEL: vessel_port, SHORE: shore_port, WATER: uuv_port}
    for platform, port in ports.items():
        parts = [_platform_table(settings, platform, port)]
        parts += [_service_table(settings, service) for service, where in PLATFORM_OF.items() if where == platform]
        if platform == VESSEL and settings.console_port is not None:
            parts.append(_console_table(settings))
        (folder / f"{platform}.toml").write_text("\n".join(parts), encoding="utf-8")


def _platform_table(settings: ChainSettings, platform: str, port: int) -> str:
    return (
        f'[platform]\nid = "{platform}"\nrouter = ["tcp/127.0.0.1:{port}"]\n'
        f'state_dir = "{settings.folder / "state" / platform}"\n'
        f"health_interval_s = {HEALTH_INTERVAL_S}\n"
        # The emulated channel has no other modems, and the paper's format has no authentication.
        'acoustic_auth = "none"\n'
        f'[modem]\ndriver = "{settings.modem}"\n'
    )


def _service_table(settings: ChainSettings, service: str) -> str:
    page = settings.console_port
    modem = '[{name}]\nport = "{port}"\naddress = {address}\n'
    codebooks = ", ".join(f'"{name}"' for name in settings.vessel_codebooks)
    tables = {
        "atd_stub": f'[atd_stub]\nmode = "{settings.mode}"\ninput_dir = "{settings.incoming}"\n'
        "poll_s = 0.2\nsettle_s = 0.5\n",
        "compressor": f'[compressor]\ncodebook = "{settings.codebook}"\n' + _codec(settings),
        "uuv_modem": modem.format(name="uuv_modem", port=settings.modem_port(UUV_ADDRESS), address=UUV_ADDRESS)
        + f"destination = {VESSEL_ADDRESS}\nrate = {settings.rate}\n"
        + _vehicle_link(settings),
        "op_modem": modem.format(name="op_modem", port=settings.modem_port(VESSEL_ADDRESS), address=VESSEL_ADDRESS)
        + f"pairing_timeout_s = {settings.pairing_timeout_s:.3f}\n"
        + _vessel_link(settings),
        "decompressor": f'[decompressor]\nout_dir = "{settings.vessel_images}"\ncodebooks = [{codebooks}]\n'
        + ("" if page is None else 'image_consumers = ["relay", "console"]\n'),
        "relay": "[relay]\n" + ("" if page is None else 'comment_consumers = ["console"]\n'),
        "c2": f'[c2]\nout_dir = "{settings.shore_images.parent}"\n',
        "acoustic_channel": f'[acoustic_channel]\ndriver = "{settings.modem}"\n'
        f'pty_dir = "{settings.ports_folder}"\nlog = "{settings.channel_log}"\n'
        f"seed = {settings.seed}\nframe_loss = {settings.loss}\ntime_scale = {settings.time_scale}\n"
        f"modem = [{{ address = {UUV_ADDRESS} }}, {{ address = {VESSEL_ADDRESS}, east_m = 100.0 }}]\n",
    }
    extra = "".join(f"{line}\n" for name, line in settings.extra if name == service)
    return tables[service] + extra


def _console_table(settings: ChainSettings) -> str:
    # The paper's link has no downlink.
    down = '"op_modem"' if settings.link == "v1" else ""
    return (
        f'[console]\nport = {settings.console_port}\nvehicles = {{ {UUV_ADDRESS} = "{UUV}" }}\n'
        f'decision_consumers = ["relay", {down}]\ncommand_consumers = [{down}]\n'
    )


def _codec(settings: ChainSettings) -> str:
    return 'codec = "vq"\n' if settings.link == "paper" else f'codec = "emb"\nbudget_bytes = {STREAM_BYTES}\n'


def _vehicle_link(settings: ChainSettings) -> str:
    if settings.link == "paper":
        return 'link = "paper"\n'
    # Services run in real time: durations in the channel are divided by the time scale; the host's own delays are not.
    scale = settings.time_scale
    status_s = max(MIN_STATUS_PERIOD_S, STATUS_PERIOD_S / scale)
    return (
        f'link = "v1"\nexpected_loss = {min(settings.loss, 0.9)}\nstream_bytes = {STREAM_BYTES}\n'
        f"tx_burst_s = {60 / scale:.3f}\nrx_window_s = {10 / scale + 0.5:.3f}\nholdoff_s = {5 / scale + 0.1:.3f}\n"
        f"queue_interval_s = 0.2\ngroup_delay_s = {20 / scale:.3f}\nretry_s = 0.2\n"
        f"max_defer_s = {120 / scale + 1:.3f}\n"
        f"reply_timeout_s = {settings.reply_timeout_s:.3f}\n"
        # The page shows the track. Without it, the frames of a demo are those of its images.
        + ("" if settings.console_port is None else f"status_period_s = {status_s:.3f}\n")
    )


def _vessel_link(settings: ChainSettings) -> str:
    vehicles = f'vehicles = {{ {UUV_ADDRESS} = "{UUV}" }}\n'
    if settings.link == "paper":
        return 'link = "paper"\n' + vehicles
    scale = settings.time_scale
    return (
        f'link = "v1"\n{vehicles}holdoff_s = {2 / scale + 0.1:.3f}\nmax_defer_s = {120 / scale + 1:.3f}\n'
        # Rate 0 needs a header before each packet, which can be lost too.
        f"downlink_rate = {settings.rate}\n"
        f"retry_s = {20 / scale + 0.5:.3f}\nfeedback_interval_s = {settings.feedback_interval_s:.3f}\n"
        f"reply_timeout_s = {settings.reply_timeout_s:.3f}\n"
    )
