"""Live contacts of a site, for commands that pass them on."""

from types import SimpleNamespace

import zenoh
from builders.common import eventually, free_port, publish_once
from builders.exports import decision, image, store

from sonarpost import keys, wire
from sonarpost.bus.session import client_config, router_config
from sonarpost.cli.c2 import live as live_module
from sonarpost.cli.c2 import watch as watch_module
from sonarpost.cli.c2.live import ContactStream
from sonarpost.export.live import LiveContacts


class PublishedRecords:
    """A session whose only subscriber receives the given records."""

    def __init__(self):
        self.info = SimpleNamespace(routers_zid=lambda: ["router"])
        self.publish = None

    def declare_subscriber(self, key, on_sample):
        self.publish = on_sample


def test_vessels_have_places_and_turns_of_their_own(monkeypatch):
    monkeypatch.setattr(watch_module, "MAX_WAITING", 10)
    session = PublishedRecords()
    watch = watch_module.RecordSubscription(session, keys.SHORE, None)
    for vessel, count in (("vessel-2", 50), ("vessel-1", 3)):
        for number in range(count):
            record = decision(f"{number:04d}", vessel_id=vessel)
            payload = SimpleNamespace(to_bytes=lambda record=record: wire.encode(record))
            session.publish(
                SimpleNamespace(kind=zenoh.SampleKind.PUT, key_expr=keys.shore_decision(vessel), payload=payload)
            )
    assert watch.gaps == 40
    order = [watch.poll().vessel_id for _ in range(13)]
    assert order[:6].count("vessel-1") == 3
    assert watch.poll() is None


def test_stream_reads_the_folder_first_and_after_an_interruption(tmp_path):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    hub = zenoh.open(router_config([endpoint]))
    folder = store(tmp_path / "out", image("0001"), image("0002", vessel_id="vessel-2"))
    session = zenoh.open(client_config([endpoint]))
    changes = []

    def poll():
        changes.extend(stream.poll())
        return [change.contact.image.image_id for change in changes]

    try:
        stream = ContactStream(session, keys.SHORE, "vessel-1", folder)
        eventually(lambda: poll() == ["0001"])
        assert changes[0].png == (folder / "vessel-1").glob("*.png").__next__().read_bytes()
        publish_once(hub, keys.shore_image("vessel-1"), wire.encode(image("0001", version=2)))
        eventually(lambda: poll() == ["0001", "0001"])
        publish_once(hub, keys.shore_decision("vessel-1"), wire.encode(decision("0001")))
        eventually(lambda: poll() == ["0001", "0001", "0001"])
        assert changes[2].contact.review == "mine_like"
        assert changes[2].png is None
        hub.close()
        store(folder, image("0003"))  # accepted while this program was not connected
        eventually(lambda: poll() == ["0001"] * 3 and not session.info.routers_zid())
        hub = zenoh.open(router_config([endpoint]))
        eventually(lambda: poll() == ["0001"] * 3 + ["0003"])
    finally:
        session.close()
        hub.close()


def test_live_contacts_have_places_by_vessel():
    live = LiveContacts(max_names=3)
    for image_id, vessel in (("0000", "vessel-1"), *((f"{n:04}", "vessel-2") for n in range(9))):
        live.add(image(image_id, vessel_id=vessel))
    names = [(contact.image.vessel_id, contact.image.image_id) for contact in live.located(9)]
    assert names == [("vessel-1", "0000"), ("vessel-2", "0007"), ("vessel-2", "0008")]


def test_contact_that_fails_ends_no_stream(monkeypatch):
    session = PublishedRecords()
    stream = ContactStream(session, keys.SHORE, None, None)
    png_of = live_module._png_of
    monkeypatch.setattr(live_module, "_png_of", lambda record: 1 / 0 if record.image_id == "0001" else png_of(record))
    for n in (1, 2):
        payload = SimpleNamespace(to_bytes=lambda n=n: wire.encode(image(f"{n:04}")))
        key = keys.shore_image("vessel-1")
        session.publish(SimpleNamespace(kind=zenoh.SampleKind.PUT, key_expr=key, payload=payload))
    assert stream.poll() == []
    assert [change.contact.image.image_id for change in stream.poll()] == ["0002"]
