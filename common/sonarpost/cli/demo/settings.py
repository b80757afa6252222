"""The configuration files of a chain on one host, written from a few choices."""

from __future__ import annotations

import math
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sonarpost.link.frames.v1.frame import HEADER_BYTES
from sonarpost.modem.micromodem import RATES

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
_PAPER_BYTES, _PAPER_HEADER_BYTES, _RECORD_BYTES, _MOST_STREAM_BYTES = 196, 13, 40, 2048


@dataclass(frozen=True)
class ChainSettings:
    """What a chain on one host is to do.

    Attributes:
        folder: Everything the chain writes lies here.
        mode: As of atd_stub.
        link: Wire format through the water: "v1" with the codec emb, or the paper's with its tile codec.
        rate: Micro-Modem rate.
        loss: Probability that a frame is lost.
        seed: Of the water.
        time_scale: Simulated seconds in the water a real second.
        codebook: Of the vehicle.
        vessel_codebooks: Of the vessel; normally the same.
        router_ports: TCP ports of the uuv, vessel and shore routers.
        shore_port_for_vessel: Where the vessel's router looks for the shore's; another than the shore's own where a
            test puts a link in between that can be cut.
        console_port: Of the operator's page on the vessel; None without one.
        extra: More lines for a service's table, by service.
    """

    folder: Path
    mode: Literal["survey", "snippets"] = "survey"
    link: Literal["v1", "paper"] = "paper"
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
        """Folder that atd_stub polls."""
        return self.folder / "uuv" / "incoming"

    @property
    def vessel_pictures(self) -> Path:
        """Where the decompressor writes."""
        return self.folder / "vessel" / "pictures"

    @property
    def shore_pictures(self) -> Path:
        """Where c2 writes what this vessel relays."""
        return self.folder / "shore" / "pictures" / VESSEL

    @property
    def channel_log(self) -> Path:
        """What the water did with every packet."""
        return self.folder / "water" / "channel.jsonl"

    @property
    def pairing_timeout_s(self) -> float:
        """Real seconds after which an image waits no longer: a few packets, and what a loaded host may add."""
        return 4 * RATES[self.rate].airtime_s / self.time_scale + 3.0

    @property
    def stream_bytes(self) -> int:
        """Bytes of a picture's stream with v1: what fits the packets that the paper's codec and format take.

        Those are the packets of a picture of 80 x 140 px in 196 bytes, half by half; 40 bytes are the record's.
        """
        rate = RATES[self.rate]
        frames_a_half = math.ceil(_PAPER_BYTES / 2 / (rate.frame_bytes - _PAPER_HEADER_BYTES))
        packets = 2 * math.ceil(frames_a_half / rate.frames)
        return min(packets * rate.frames * (rate.frame_bytes - HEADER_BYTES) - _RECORD_BYTES, _MOST_STREAM_BYTES)

    @property
    def feedback_interval_s(self) -> float:
        """Real seconds from one report of the vessel to the next, with v1."""
        return 30.0 / self.time_scale + 0.5

    @property
    def reply_timeout_s(self) -> float:
        """Real seconds that drivers wait for their modem, with v1: one that is receiving answers when it is done."""
        return 5.0 / self.time_scale + 1.0

    @property
    def settled_s(self) -> float:
        """Real seconds without any change after which pictures that lack something will not get it any more."""
        airtime_s = RATES[self.rate].airtime_s / self.time_scale
        return 3 * self.feedback_interval_s + 4 * airtime_s if self.link == "v1" else airtime_s

    @property
    def ports_folder(self) -> Path:
        """Folder of the emulated modems' pseudo-terminals."""
        return self.folder / "water" / "ports"

    def modem_port(self, address: int) -> Path:
        """Path of the pseudo-terminal of an emulated modem: the emulator numbers them in the order of its table."""
        return self.ports_folder / f"modem-{(UUV_ADDRESS, VESSEL_ADDRESS).index(address) + 1}"

    def config_file(self, service: str) -> Path:
        """Return the file a service reads."""
        # Only the vessel's page is not always there.
        return self.folder / "config" / f"{PLATFORM_OF.get(service, VESSEL)}.toml"


def free_ports(count: int) -> tuple[int, ...]:
    """Return TCP ports that are free now, all different."""
    probes = [socket.socket() for _ in range(count)]
    try:
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return tuple(int(probe.getsockname()[1]) for probe in probes)
    finally:
        for probe in probes:
            probe.close()


def write_config(settings: ChainSettings) -> None:
    """Write one TOML file a platform."""
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
        + _vessel_link(settings),
        "decompressor": f'[decompressor]\nout_dir = "{settings.vessel_pictures}"\n'
        f"pairing_timeout_s = {settings.pairing_timeout_s:.3f}\ncodebooks = [{codebooks}]\n"
        f'vehicles = {{ {UUV_ADDRESS} = "{UUV}" }}\n'
        + ("" if page is None else 'image_consumers = ["relay", "console"]\n'),
        "relay": "[relay]\n" + ("" if page is None else 'advice_consumers = ["console"]\n'),
        "c2": f'[c2]\nout_dir = "{settings.shore_pictures.parent}"\n',
        "acoustic_channel": f'[acoustic_channel]\npty_dir = "{settings.ports_folder}"\nlog = "{settings.channel_log}"\n'
        f"seed = {settings.seed}\nframe_loss = {settings.loss}\ntime_scale = {settings.time_scale}\n"
        f"modem = [{{ address = {UUV_ADDRESS} }}, {{ address = {VESSEL_ADDRESS}, east_m = 100.0 }}]\n",
    }
    extra = "".join(f"{line}\n" for name, line in settings.extra if name == service)
    return tables[service] + extra


def _console_table(settings: ChainSettings) -> str:
    # The paper's link carries nothing down.
    down = '"op_modem"' if settings.link == "v1" else ""
    return (
        f'[console]\nport = {settings.console_port}\nvehicles = {{ {UUV_ADDRESS} = "{UUV}" }}\n'
        f'decision_consumers = ["relay", {down}]\ncommand_consumers = [{down}]\n'
    )


def _codec(settings: ChainSettings) -> str:
    return f'codec = "emb"\nbudget_bytes = {settings.stream_bytes}\n' if settings.link == "v1" else ""


def _vehicle_link(settings: ChainSettings) -> str:
    if settings.link == "paper":
        return 'link = "paper"\n'
    # Services keep real time: what takes seconds in the water takes so much less here, and the host its own time.
    scale = settings.time_scale
    return (
        f'link = "v1"\nexpected_loss = {min(settings.loss, 0.9)}\nstream_bytes = {settings.stream_bytes}\n'
        f"tx_burst_s = {60 / scale:.3f}\nrx_window_s = {10 / scale + 0.5:.3f}\nqueue_interval_s = 0.2\n"
        f"group_delay_s = {20 / scale:.3f}\nretry_s = 0.2\nreply_timeout_s = {settings.reply_timeout_s:.3f}\n"
    )


def _vessel_link(settings: ChainSettings) -> str:
    vehicles = f'vehicles = {{ {UUV_ADDRESS} = "{UUV}" }}\n'
    if settings.link == "paper":
        return 'link = "paper"\n' + vehicles
    scale = settings.time_scale
    return (
        f'link = "v1"\n{vehicles}holdoff_s = {2 / scale + 0.1:.3f}\nmax_defer_s = {120 / scale + 1:.3f}\n'
        f"retry_s = {60 / scale + 0.5:.3f}\nfeedback_interval_s = {settings.feedback_interval_s:.3f}\n"
        f"reply_timeout_s = {settings.reply_timeout_s:.3f}\n"
    )
