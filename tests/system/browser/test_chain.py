"""From the vehicle's modem to the operator and back: every service in between is the real one, in this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from builders.common import eventually

from sonarpost import keys, wire
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.messages import Command, Contact, Decision, EncodedImage, Pixels, Record
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.service import ConsoleService
from sonarpost.services.console.store.users import FILE_NAME, Users
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.service import UuvModemService
from sonarpost.simulation.channel.acoustics import LocalPosition
from sonarpost.simulation.channel.emulator import ChannelEmulator, EmulatorConfig, ModemSite
from sonarpost.simulation.channel.parameters import ChannelParameters
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey

TIME_SCALE = 60.0
VEHICLES = {"3": "uuv-1"}

# What a row's share of the picture has been, in order, whatever the page has drawn since.
RECORD_SHARES = """() => {
  window.shares = [];
  const look = () => document.querySelectorAll('.row .share').forEach(e => {
    if (window.shares.at(-1) !== e.textContent) window.shares.push(e.textContent);
  });
  new MutationObserver(look).observe(document.querySelector('.space'), {childList: true, subtree: true});
}"""


class Program(Service[ServiceConfig]):
    """A program on the vehicle beside sonarpost: takes records, and owes some."""

    NAME = "program"

    def __init__(self, platform: PlatformConfig, takes: Mapping[str, type[Record]]) -> None:
        super().__init__(platform, ServiceConfig())
        self._takes = takes
        self.got: list[Any] = []

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        return self._takes

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        self.got.append(record)

    def owe(self, key: str, consumer: str, record: Record) -> None:
        effects = UnitOfWork()
        effects.send(key, consumer, record, priority=4)
        self.commit(effects)


class Compressor(Program):
    NAME = "compressor"


class Autonomy(Program):
    NAME = "autonomy"


@pytest.fixture
def start() -> Iterator[Callable[[Service[Any]], Any]]:
    """Starts services, and stops all of them at the end."""
    running: list[Service[Any]] = []

    def begin(service: Service[Any]) -> Any:
        assert service.start()
        running.append(service)
        return service

    yield begin
    with ThreadPoolExecutor() as pool:
        for stopped in [pool.submit(service.stop) for service in running]:
            stopped.result()


@pytest.fixture
def ports(tmp_path: Path) -> Iterator[tuple[str, str]]:
    """Modem ports of vessel and vehicle, 150 m apart, where time runs fast."""
    sites = (ModemSite(1), ModemSite(3, LocalPosition(150.0)))
    channel = ChannelEmulator(
        EmulatorConfig(sites, ChannelParameters(), pty_dir=tmp_path / "sea", time_scale=TIME_SCALE)
    )
    channel.start()
    yield str(tmp_path / "sea" / "modem-1"), str(tmp_path / "sea" / "modem-2")
    channel.stop()


def encoded() -> EncodedImage:
    """A picture of a simulated object, in a few hundred bytes."""
    simulated = simulate_survey(SurveySpec(seed=4, pings=200, samples=512, targets=1, clutter=0))
    found = simulated.truth[0]
    echo = simulated.survey.waterfall(found.side)
    top = min(max(0, found.ping - 40), echo.shape[0] - 80)
    left = min(max(0, found.sample_index - 40), echo.shape[1] - 80)
    cut = echo[top : top + 80, left : left + 80]
    picture = (255 * (cut / np.percentile(cut, 99.5)).clip(0, 1)).astype(np.uint8)
    contact = Contact(
        contact_id="c1", vehicle_id="uuv-1", channel="port", lat_deg=found.lat_deg, lon_deg=found.lon_deg,
        position_sigma_m=4.0, altitude_m=5.0, heading_deg=40.0, ground_range_m=12.0, atd_confidence=1.6,
        time_utc_s=1_700_000_000.0, pixel_along_m=0.1, pixel_across_m=0.05,
    )  # fmt: skip
    return EncodedImage(
        vehicle_id="uuv-1", image_id="0007", contact=contact, codec="emb", model="", height_px=80, width_px=80,
        stream=EmbCodec().encode(picture, 512), original_sha256=Pixels.from_array(picture).sha256,
    )  # fmt: skip


def test_seen_measured_decided_and_told(
    router: str, client: zenoh.Session, platform: Any, start: Any, ports: tuple[str, str], tmp_path: Path, visit: Any
) -> None:
    ashore: list[Decision] = []
    client.declare_subscriber(
        keys.shore_decision("vessel-1"),
        lambda sample: ashore.append(wire.decode(Decision, sample.payload.to_bytes(), str(sample.key_expr))),
    )
    compressor = start(Compressor(platform("uuv-1"), {}))
    orders = {keys.command("uuv-1", "decision"): Decision, keys.command("uuv-1", "revisit"): Command}
    autonomy = start(Autonomy(platform("uuv-1"), orders))
    start(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "shore-out")))
    start(RelayService(platform("vessel-1"), RelayConfig()))
    vessel = ConsoleConfig(port=0, vehicles=VEHICLES)
    users = Users(tmp_path / "state" / "vessel-1" / FILE_NAME)
    users.add("anna", "operator", "correct horse battery")
    console = start(ConsoleService(platform("vessel-1"), vessel))
    into = {"out_dir": tmp_path / "out", "image_consumers": ("relay", "console"), "vehicles": VEHICLES}
    start(DecompressorService(platform("vessel-1"), DecompressorConfig(**into)))
    start(
        OpModemService(
            platform("vessel-1"), OpModemConfig(port=ports[0], vehicles=VEHICLES, retry_s=0.5, holdoff_s=0.05)
        )
    )
    takers = {"decision_consumers": ("autonomy",), "revisit_consumers": ("autonomy",)}
    line = {"rate": 1, "group_delay_s": 0.3, "rx_window_s": 0.0, "holdoff_s": 0.15, "retry_s": 0.05, **takers}
    start(UuvModemService(platform("uuv-1"), UuvModemConfig(port=ports[1], **line)))

    there = visit(console.address, users.begin("anna").token)
    there.page.evaluate(RECORD_SHARES)
    compressor.owe(keys.image_encoded("uuv-1"), "uuv_modem", encoded())
    # It appears while frames still arrive, and is refined to the end.
    there.wait('.row[data-id*=".0007"]')
    there.shows("0007")
    there.wait('.row .share >> text="100\u202f%"')
    shares = [words for words in there.page.evaluate("window.shares") if words[0].isdigit()]
    assert len(shares) > 1, shares
    assert shares[-1] == "100\u202f%"
    assert there.pixels() > 1000
    # Measured, decided by two keys.
    there.press("m", "m", "m", "Enter", *["Shift+ArrowRight"] * 4, "Enter")
    there.wait(".hint >> text=Enter keeps it")
    there.press("Enter")
    there.wait('details[data-name="measurements"] >> text=height')
    there.press("1", "Enter")
    # It comes ashore and to the vehicle, and the page says so.
    eventually(lambda: len(autonomy.got) == 1 and len(ashore) == 1, what="the decision, ashore and on the vehicle")
    for record in (*ashore, *autonomy.got):
        assert (record.vehicle_id, record.image_id, record.verdict) == ("uuv-1", "0007", "mine_like")
    assert ashore[0].operator == "anna"
    there.wait('.progress >> text="ashore"')
    there.wait(".progress >> text=on the vehicle")
    # All of the picture is here: not more of it but another look, of which the cost is shown, is asked for, and the
    # vehicle hears it.
    there.press("r")
    there.wait("dialog .costs input[value=refine]:checked")
    there.press("ArrowDown")
    there.wait("dialog .costs input[value=revisit]:checked")
    there.press("Enter")
    eventually(lambda: len(autonomy.got) == 2, what="the order on the vehicle")
    assert autonomy.got[1].kind == "revisit"
    there.wait('details[data-name="requests"] >> text=the vehicle has it')
    users.close()
