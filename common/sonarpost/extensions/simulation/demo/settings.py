"""Settings of a chain on one host, and the configuration files written from them."""

import json
import socket
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sonarpost.errors import PortError
from sonarpost.modem.interface import RateInfo
from sonarpost.modem.registry import DEFAULT_DRIVER, modem_driver

ROUTER_PORTS = (7467, 7457, 7447)
"""Ports of the routers of a demo's vehicle, vessel and shore site, if they are free. 7447 is Zenoh's usual port."""
CONSOLE_PORT = 8470
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
    def feedback_interval_s(self) -> float:
        """Real time between two feedback messages of the vessel, with v1."""
        return 20.0 / self.time_scale + 0.5

    @property
    def ports_folder(self) -> Path:
        """Folder of the emulated modems' pseudo-terminals."""
        return self.folder / "water" / "ports"

    @property
    def routers_line(self) -> str:
        """Endpoints of the three routers, as text."""
        names = ("vehicle", "vessel", "shore site")
        pairs = zip(names, self.router_ports, strict=True)
        return "routers: " + ", ".join(f"{name} tcp/127.0.0.1:{port}" for name, port in pairs)

    def modem_port(self, address: int) -> Path:
        """Path of the pseudo-terminal of an emulated modem; the emulator numbers them in the order of its table."""
        return self.ports_folder / f"modem-{(UUV_ADDRESS, VESSEL_ADDRESS).index(address) + 1}"

    def config_file(self, service: str) -> Path:
        """Return the configuration file of a service; the optional console belongs to the vessel."""
        return self.folder / "config" / f"{PLATFORM_OF.get(service, VESSEL)}.toml"


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
    ports = dict(zip((UUV, VESSEL, SHORE, WATER), (*settings.router_ports, settings.router_ports[0]), strict=True))
    lines: dict[str, list[str]] = {platform: [] for platform in ports}
    for platform, port in ports.items():
        table = {
            "id": platform,
            "router": [f"tcp/127.0.0.1:{port}"],
            "state_dir": settings.folder / "state" / platform,
            "health_interval_s": HEALTH_INTERVAL_S,
            # The emulated channel has no other modems, and the paper's format has no authentication.
            "acoustic_auth": "none",
        }
        for name, values in (("platform", table), ("modem", {"driver": settings.modem})):
            lines[platform] += [f"[{name}]", *(f"{key} = {_toml(value)}" for key, value in values.items())]
    for service, values in _service_tables(settings).items():
        extra = [line for name, line in settings.extra if name == service]
        own = [f"{key} = {_toml(value)}" for key, value in values.items()]
        lines[PLATFORM_OF.get(service, VESSEL)] += [f"[{service}]", *own, *extra]
    for platform, text in lines.items():
        (folder / f"{platform}.toml").write_text("\n".join(text) + "\n", encoding="utf-8")


def _toml(value: object) -> str:
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value, ensure_ascii=False, default=str)


def _service_tables(settings: ChainSettings) -> dict[str, dict[str, object]]:
    """Return the tables of the services. Those with v1 have durations in the channel divided by the time scale.

    The services run in real time; the delays of the host itself are not divided.
    """
    is_v1, scale, has_page = settings.link == "v1", settings.time_scale, settings.console_port is not None
    vehicle: dict[str, object] = {
        "port": settings.modem_port(UUV_ADDRESS),
        "address": UUV_ADDRESS,
        "destination": VESSEL_ADDRESS,
        "rate": settings.rate,
        "link": settings.link,
    }
    vessel: dict[str, object] = {
        "port": settings.modem_port(VESSEL_ADDRESS),
        "address": VESSEL_ADDRESS,
        "pairing_timeout_s": round(4 * settings.packet_s + 3.0, 3),
        "link": settings.link,
        "vehicles": {UUV_ADDRESS: UUV},
    }
    if is_v1:
        both = {"max_defer_s": round(120 / scale + 1, 3), "reply_timeout_s": round(5 / scale + 1.0, 3)}
        vehicle |= both | {
            "expected_loss": min(settings.loss, 0.9),
            "stream_bytes": STREAM_BYTES,
            "tx_burst_s": round(60 / scale, 3),
            "rx_window_s": round(10 / scale + 0.5, 3),
            "holdoff_s": round(5 / scale + 0.1, 3),
            "queue_interval_s": 0.2,
            "group_delay_s": round(20 / scale, 3),
            "retry_s": 0.2,
        }
        if has_page:  # it shows the track; without it, the frames of a demo are those of its images
            vehicle["status_period_s"] = round(max(MIN_STATUS_PERIOD_S, STATUS_PERIOD_S / scale), 3)
        vessel |= both | {
            "holdoff_s": round(2 / scale + 0.1, 3),
            "downlink_rate": settings.rate,  # rate 0 needs a header before each packet, which can be lost too
            "retry_s": round(20 / scale + 0.5, 3),
            "feedback_interval_s": round(settings.feedback_interval_s, 3),
        }
    codec: dict[str, object] = {"codec": "emb", "budget_bytes": STREAM_BYTES} if is_v1 else {"codec": "vq"}
    down = ["op_modem"] if is_v1 else []  # the paper's link has no downlink
    tables: dict[str, dict[str, object]] = {
        "atd_stub": {"mode": settings.mode, "input_dir": settings.incoming, "poll_s": 0.2, "settle_s": 0.5},
        "compressor": codec,
        "uuv_modem": vehicle,
        "op_modem": vessel,
        "decompressor": {
            "out_dir": settings.vessel_images,
            **({"image_consumers": ["relay", "console"]} if has_page else {}),
        },
        "relay": {"comment_consumers": ["console"]} if has_page else {},
        "c2": {"out_dir": settings.shore_images.parent},
        "acoustic_channel": {
            "driver": settings.modem,
            "pty_dir": settings.ports_folder,
            "log": settings.channel_log,
            "seed": settings.seed,
            "frame_loss": settings.loss,
            "time_scale": settings.time_scale,
            "modem": [{"address": UUV_ADDRESS}, {"address": VESSEL_ADDRESS, "east_m": 100.0}],
        },
    }
    if has_page:
        tables["console"] = {
            "port": settings.console_port,
            "vehicles": {UUV_ADDRESS: UUV},
            "decision_consumers": ["relay", *down],
            "command_consumers": down,
        }
    return tables
