"""The chain of places, its banners, and the alerts, in a real browser."""

import math
import time
from dataclasses import asdict

import pytest
import zenoh
from builders.common import eventually, free_port
from builders.console import VESSEL, encoded_health, image_record, received_frame
from builders.services import modem_pair, runner

from sonarpost.bus.session import router_config
from sonarpost.services.console import chain
from sonarpost.services.console.chain import RouterState
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.service import ConsoleService
from sonarpost.services.console.store.users import FILE_NAME, Users
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService

__all__ = ["modem_pair", "runner"]


def report(served, service, state="ok", detail="", **gauges):
    health = encoded_health(service, VESSEL, state, detail, time.time(), **gauges)
    served.state.fleet.services.add(*health, time.monotonic())


def receive_frame(served, vehicle="uuv-1", age_s=0.0):
    served.state.fleet.add_frame(vehicle, received_frame(time.time() - age_s), time.monotonic() - age_s)


def publish(served):
    eventually(lambda: served.state.events.subscriber_count == 1, what="event stream")
    served.state.events.publish("fleet", served.state.fleet_state())


@pytest.fixture
def vessel(served, monkeypatch):
    """A console whose places all work. A test repeats no reports, however long the browser takes."""
    monkeypatch.setattr(chain, "SERVICE_STALE_S", math.inf)
    now = time.time()
    times = {"changed_utc_s": now - 600, "listening_since_utc_s": now - 600}
    served.state.router = RouterState(platform_id=VESSEL, reached=True, detail="tcp/127.0.0.1", **times)
    for service in ("console", "decompressor", "op_modem"):
        report(served, service, modem_ready=1.0)
    receive_frame(served)
    return served


def place(name, state):
    return f'#chain .place[data-place="{name}"][data-state="{state}"]'


def test_each_lost_place_is_named_in_the_chain_and_in_a_banner(vessel):
    visit = vessel.visit(viewport={"width": 1920, "height": 1080})
    for name in ("browser", "server", "router", "modem", "vehicle"):
        visit.wait(place(name, "ok"))
    assert visit.page.locator("#banners p").count() == 0
    assert visit.text("#chain summary").split()[-4:-1] == ["●", "uuv-1", visit.text("#chain .age").split()[0]]
    # The modem is unplugged.
    report(vessel, "op_modem", "degraded", "/dev/ttyUSB0: device reports readiness to read", modem_ready=0.0)
    publish(vessel)
    visit.wait(place("modem", "lost"))
    visit.wait(place("vehicle", "unknown"))
    assert "the modem does not reply: /dev/ttyUSB0" in visit.text("#fault")
    # The router hides all that is behind it.
    vessel.state.router = vessel.state.router.changed(time.time(), reached=False)
    publish(vessel)
    visit.wait(place("router", "lost"))
    visit.wait(place("modem", "unknown"))
    since = time.strftime("%H:%M UTC", time.gmtime(vessel.state.router.changed_utc_s))
    assert visit.text("#fault").startswith(f"No images can arrive since {since}: the router is not reached")
    assert visit.page.get_attribute("#bar", "data-worst") == "lost"
    # All places work again.
    vessel.state.router = vessel.state.router.changed(time.time(), reached=True)
    for service in ("console", "decompressor", "op_modem"):
        report(vessel, service, modem_ready=1.0)
    receive_frame(vessel)
    publish(vessel)
    visit.wait(place("modem", "ok"))
    visit.until("() => !document.getElementById('fault')")
    # A vehicle is silent.
    receive_frame(vessel, "uuv-2", age_s=121.0)
    publish(vessel)
    visit.wait(place("vehicle", "degraded"))
    assert "no frames from uuv-2" in visit.text("#fault")
    visit.page.click("#chain summary")
    visit.wait("#chain .places >> text=uuv-1")
    assert "no frames from uuv-2" in visit.text("#chain .places")
    visit.press("Escape")
    visit.until("() => !document.getElementById('chain').open")


def test_unauthenticated_site_is_stated_once_in_the_header(vessel):
    for image_id in ("0001", "0002"):
        vessel.state.store_image(image_record(image_id).model_copy(update={"authenticated": False}))
    visit = vessel.visit()
    visit.wait_for_contact("0002")
    visit.wait("#unauthenticated >> text=unauthenticated")
    visit.until("() => document.querySelectorAll('.row').length === 2")
    # It is a setting of the site: no mark of a row or image, and not the cause of a fault.
    assert visit.page.locator(".row .unauthenticated, #banners p").count() == 0
    # Where other contacts are authenticated, those that are not have a mark.
    vessel.state.store_image(image_record("0003").model_copy(update={"authenticated": True}))
    visit.page.locator("#unauthenticated").wait_for(state="hidden")
    visit.until("() => document.querySelectorAll('.row .unauthenticated').length === 2")


def test_each_failure_of_running_services_is_named(platform, runner, modem_pair, tmp_path, visit):
    """A silent vehicle, an unplugged modem, an ended router and an ended server, each at its place on one open page."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    router = zenoh.open(router_config([endpoint]))
    try:
        settings = platform(VESSEL).model_copy(update={"router": (endpoint,)})
        users = Users(settings.state_dir / FILE_NAME)
        users.add("anna", "operator", "correct horse battery")
        console = runner.start(ConsoleService(settings, ConsoleConfig(port=0, vehicle_stale_s=1.0)))
        decoder = DecompressorConfig(out_dir=tmp_path / "out", image_consumers=("console",))
        runner.start(DecompressorService(settings, decoder))
        modem_pair.start()
        modem = OpModemConfig(port=modem_pair.port(modem_pair.VESSEL), vehicles={"3": "uuv-1"})
        runner.start(OpModemService(settings, modem))
        page = visit(console.address, users.start_session("anna").token)
        page.expect_errors("Failed to load resource", "ERR_", "net::")
        page.wait(place("modem", "ok"))
        console.state.fleet.add_frame("uuv-1", received_frame())
        page.wait(place("vehicle", "degraded"))
        assert "no frames from uuv-1" in page.text("#fault")
        modem_pair.stop()
        page.wait(place("modem", "lost"))
        assert "the modem does not reply" in page.text("#fault")
    finally:
        router.close()
    page.wait(place("router", "lost"))
    assert "the router is not reached" in page.text("#fault")
    console.stop()
    page.wait(place("server", "lost"))
    assert "No connection to the console's server" in page.text("#offline")
    users.close()


def test_page_whose_stream_is_refused_states_the_reason(vessel, monkeypatch):
    monkeypatch.setattr("sonarpost.services.console.web.event_stream.MAX_STREAMS_OF_USER", 1)
    first = vessel.visit()
    first.wait(place("browser", "ok"))
    second = vessel.visit()
    second.expect_errors("429", "establish a connection")
    second.wait(place("browser", "degraded"))
    banner = second.text("#offline")
    assert "You have too many open pages of the console" in banner
    assert "No connection" not in banner
    # The server is reached: it has refused the stream.
    assert second.page.locator(place("server", "lost")).count() == 0


FAKES = """() => {
  window.tones = 0;
  window.notes = [];
  const parameter = { value: 0, setValueAtTime() {} };
  window.AudioContext = class {
    state = "running"; currentTime = 0; destination = {};
    createGain() { return { gain: parameter, connect() {} }; }
    createOscillator() { return { frequency: parameter, connect() {}, start() { window.tones += 1; }, stop() {} }; }
  };
  window.Notification = class {
    static permission = "default";
    static async requestPermission() { this.permission = "granted"; return "granted"; }
    constructor(title, options) { window.notes.push([title, options.body]); }
    close() {}
  };
}"""

ALERTED = '.row.alert[data-id*=".{}"]'


def test_alert_for_an_arriving_contact_above_the_threshold(vessel):
    vessel.state.store_image(image_record("0001", atd_confidence=1.9))
    visit = vessel.visit()
    visit.page.evaluate(FAKES)
    visit.wait_for_contact("0001")
    eventually(lambda: vessel.state.events.subscriber_count == 1, what="event stream")
    # Alerts are off by default.
    vessel.state.store_image(image_record("0002", atd_confidence=1.9))
    visit.wait('.row[data-id*=".0002"]')
    assert visit.page.evaluate("[window.tones, window.notes.length]") == [0, 0]
    visit.page.click("#alerts")
    visit.page.check("#alerts-on")
    visit.page.select_option("#alerts-threshold", "1")
    visit.page.click('dialog [data-action="save"]')
    visit.until("() => document.getElementById('alerts').title.includes('from 1.0;')")

    vessel.state.store_image(image_record("0003", atd_confidence=0.9))
    visit.wait('.row[data-id*=".0003"]')
    vessel.state.store_image(image_record("0004", atd_confidence=1.25))
    visit.wait(ALERTED.format("0004"))
    assert visit.page.locator(".row.alert").count() == 1
    assert visit.page.evaluate("window.tones") == 1
    assert visit.page.evaluate("window.notes") == [["New contact uuv-1/0004", "Detector 1.25 of 2"]]
    assert visit.page.title().startswith("1 alert · (4)")
    # Neither another version nor a repeated event alerts again.
    vessel.state.store_image(image_record("0004", 2, atd_confidence=1.25))
    contact = vessel.contact("0004")["contact"]
    vessel.state.events.publish("contact", {"contact": contact, "new": True, **asdict(vessel.state.counts())})
    # The confidence of a contact can arrive after its first frame.
    vessel.state.store_image(image_record("0005", atd_confidence=None))
    vessel.state.store_image(image_record("0005", 2, atd_confidence=2.0))
    visit.wait(ALERTED.format("0005"))
    assert visit.page.evaluate("[window.tones, window.notes.length]") == [2, 2]
    assert visit.page.title().startswith("2 alerts · ")
    # An alert ends when its contact is opened.
    visit.page.click('.row[data-id*=".0004"]')
    visit.wait_for_contact("0004")
    assert visit.page.title().startswith("1 alert · ")
    # A reload does not alert.
    visit.page.add_init_script(f"({FAKES})()")
    visit.page.reload()
    visit.wait('.row[data-id*=".0005"]')
    assert visit.page.evaluate("[window.tones, document.querySelectorAll('.row.alert').length]") == [0, 0]
