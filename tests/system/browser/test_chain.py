"""From the vehicle to the operator's page and back, with the real services in this process."""

import io
import json
import threading
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from builders.common import WAIT_S, eventually
from builders.services import ModemPair, ServiceRunner, modem_pair, runner

from sonarpost import keys, wire
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.messages import Command, Contact, Decision, EncodedImage, Pixels
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

__all__ = ["modem_pair", "runner"]

TIME_SCALE = 60.0
VEHICLES = {"3": "uuv-1"}

# Records all values of the received share of a row.
RECORD_SHARES = """() => {
  window.shares = [];
  const look = () => document.querySelectorAll('.row .share').forEach(e => {
    if (window.shares.at(-1) !== e.textContent) window.shares.push(e.textContent);
  });
  new MutationObserver(look).observe(document.querySelector('.space'), {childList: true, subtree: true});
}"""


class HoldAfterFirstPacket(io.StringIO):
    """Output of the channel's log that holds the channel once the vessel has a packet, until `go_on`."""

    def __init__(self) -> None:
        super().__init__()
        self.go_on = threading.Event()

    def write(self, text: str) -> int:
        line = json.loads(text)
        if line["event"] == "packet" and line["heard"] and line["receiver_modem"] == ModemPair.VESSEL:
            self.go_on.wait(WAIT_S)
        return len(text)


def encoded() -> EncodedImage:
    """The image of a simulated object in 512 bytes."""
    simulated = simulate_survey(SurveySpec(seed=4, pings=200, samples=512, targets=1, clutter=0))
    target = simulated.truth[0]
    echo = simulated.survey.waterfall(target.side)
    top = min(max(0, target.ping - 40), echo.shape[0] - 80)
    left = min(max(0, target.sample_index - 40), echo.shape[1] - 80)
    cut = echo[top : top + 80, left : left + 80]
    snippet = (255 * (cut / np.percentile(cut, 99.5)).clip(0, 1)).astype(np.uint8)
    contact = Contact(
        contact_id="c1", vehicle_id="uuv-1", channel="port", lat_deg=target.lat_deg, lon_deg=target.lon_deg,
        position_sigma_m=4.0, altitude_m=5.0, heading_deg=40.0, ground_range_m=12.0, atd_confidence=1.6,
        time_utc_s=1_700_000_000.0, pixel_along_m=0.1, pixel_across_m=0.05,
    )  # fmt: skip
    return EncodedImage(
        vehicle_id="uuv-1", image_id="0007", contact=contact, codec="emb", model="", height_px=80, width_px=80,
        stream=EmbCodec().encode(snippet, 512), original_sha256=Pixels.from_array(snippet).sha256,
    )  # fmt: skip


def test_contact_is_received_measured_and_decided(
    client: zenoh.Session, platform: Any, runner: ServiceRunner, modem_pair: ModemPair, tmp_path: Path, visit: Any
) -> None:
    channel_log = HoldAfterFirstPacket()
    modem_pair.start(time_scale=TIME_SCALE, echo=channel_log)
    at_shore: list[Decision] = []
    client.declare_subscriber(
        keys.shore_decision("vessel-1"),
        lambda sample: at_shore.append(wire.decode(Decision, sample.payload.to_bytes(), str(sample.key_expr))),
    )
    compressor = runner.peer("uuv-1", "compressor")
    downlink = {keys.command("uuv-1", "decision"): Decision, keys.command("uuv-1", "revisit"): Command}
    autonomy = runner.peer("uuv-1", "autonomy", downlink)
    runner.start(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "shore-out")))
    runner.start(RelayService(platform("vessel-1"), RelayConfig()))
    users = Users(tmp_path / "state" / "vessel-1" / FILE_NAME)
    users.add("anna", "operator", "correct horse battery")
    console = runner.start(
        ConsoleService(platform("vessel-1"), ConsoleConfig(port=0, vehicles=VEHICLES, take_back_s=0))
    )
    decompressor = {"out_dir": tmp_path / "out", "image_consumers": ("relay", "console")}
    runner.start(DecompressorService(platform("vessel-1"), DecompressorConfig(**decompressor)))
    op_modem = {"port": modem_pair.port(modem_pair.VESSEL), "vehicles": VEHICLES, "retry_s": 0.5, "holdoff_s": 0.05}
    runner.start(OpModemService(platform("vessel-1"), OpModemConfig(**op_modem)))
    uuv_modem = {
        "port": modem_pair.port(modem_pair.VEHICLE),
        "rate": 1,
        "group_delay_s": 0.3,
        "rx_window_s": 0.0,
        "holdoff_s": 0.15,
        "retry_s": 0.05,
        "decision_consumers": ("autonomy",),
        "revisit_consumers": ("autonomy",),
    }
    runner.start(UuvModemService(platform("uuv-1"), UuvModemConfig(**uuv_modem)))

    operator = visit(console.address, users.start_session("anna").token)
    operator.page.evaluate(RECORD_SHARES)
    compressor.send(keys.image_encoded("uuv-1"), "uuv_modem", encoded())
    # The contact appears before its image is complete, and is updated until then.
    operator.wait('.row[data-id*=".0007"]')
    operator.wait_for_contact("0007")
    operator.wait(".row .share >> text=/^preview /")
    channel_log.go_on.set()
    operator.wait(".row .share >> text=/^sent /")
    shares = operator.page.evaluate("window.shares")
    assert len(shares) > 1, shares
    assert shares[-1].startswith("sent ")
    assert operator.pixels() > 1000
    # Measure the shadow, and decide with one key.
    # The range of this image rises downwards: it is turned so that it fills its stage.
    operator.press("m", "m", "m", "Enter", *["Shift+ArrowDown"] * 4, "Enter")
    operator.wait(".size-panel >> text=±")
    operator.press("Enter")
    operator.wait('details[data-name="measurements"] >> text=height')
    operator.decide("1")
    # The decision is delivered to shore site and vehicle, and the page shows it.
    eventually(lambda: len(autonomy.received) == 1 and len(at_shore) == 1, what="the decision at shore and vehicle")
    for record in (*at_shore, *autonomy.received):
        assert (record.vehicle_id, record.image_id, record.verdict) == ("uuv-1", "0007", "mine_like")
    assert at_shore[0].operator == "anna"
    operator.wait(".standing [title='at the shore site']")
    operator.wait(".standing [title^='on the vehicle']")
    # The image is complete. A revisit is requested after its cost was displayed.
    operator.press("r")
    operator.wait("[data-request=refine]:focus")
    operator.page.locator("[data-request=revisit]").focus()
    operator.press("Enter")
    eventually(lambda: len(autonomy.received) == 2, what="the command on the vehicle")
    assert autonomy.received[1].kind == "revisit"
    operator.wait('details[data-name="requests"] >> text=accepted by the vehicle')
    users.close()
