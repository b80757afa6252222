"""Live contacts of a site, for commands that pass them on."""

import zenoh
from builders.common import eventually, free_port
from builders.exports import decision, image
from builders.shore import Site

from sonarpost import keys, wire
from sonarpost.bus.catch_up import CatchUpSubscriber
from sonarpost.bus.session import client_config, router_config
from sonarpost.cli.c2 import watch as live_module
from sonarpost.cli.c2.watch import ContactStream
from sonarpost.export.live import LiveContacts
from sonarpost.review.rendering import encode_png


def test_stream_has_the_stored_contacts_and_those_missed_in_an_interruption(monkeypatch, capsys):
    monkeypatch.setattr("sonarpost.bus.catch_up.RETRY_S", 0.1)
    monkeypatch.setattr("sonarpost.cli.c2.watch.DISCONNECTED_AFTER_S", -1.0)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    hub = zenoh.open(router_config([endpoint]))
    records = [image("0001"), image("0002", vessel_id="vessel-2")]
    site = Site(hub, *records)
    session = zenoh.open(client_config([endpoint]))
    changes = []

    def poll():
        changes.extend(stream.poll())
        return [change.contact.image.image_id for change in changes]

    try:
        stream = ContactStream(session, keys.SHORE, "vessel-1", stored=True)
        eventually(lambda: poll() == ["0001"])
        assert changes[0].png == encode_png(image("0001").pixels.to_array())
        records += [image("0001", version=2), decision("0001")]
        site.accept(*records[2:])
        eventually(lambda: poll() == ["0001"] * 3)
        assert (changes[2].contact.review, changes[2].png) == ("mine_like", None)
        hub.close()
        eventually(lambda: poll() == ["0001"] * 3 and not session.info.routers_zid())
        poll(), poll()
        assert "router not reached" in capsys.readouterr().err
        stream._records._refresh_s = 0.2
        hub = zenoh.open(router_config([endpoint]))
        Site(hub, *records, image("0003"))  # accepted while this program was not connected
        eventually(lambda: poll() == ["0001"] * 3 + ["0003"])
        assert "router reconnected" in capsys.readouterr().err
    finally:
        session.close()
        hub.close()


def test_stream_without_stored_contacts_begins_with_the_next(client, router):
    site = Site(client, image("0001"))
    with zenoh.open(client_config([router])) as session:
        stream = ContactStream(session, keys.SHORE, None, stored=False)
        eventually(lambda: stream.poll() == [] and stream._records.is_caught_up)
        site.accept(image("0002"))
        eventually(lambda: [change.contact.image.image_id for change in stream.poll()] == ["0002"])


def test_live_contacts_have_places_by_vessel():
    live = LiveContacts(max_names=3)
    for image_id, vessel in (("0000", "vessel-1"), *((f"{n:04}", "vessel-2") for n in range(9))):
        live.add(image(image_id, vessel_id=vessel))
    names = [(contact.image.vessel_id, contact.image.image_id) for contact in live.located(9)]
    assert names == [("vessel-1", "0000"), ("vessel-2", "0007"), ("vessel-2", "0008")]


def test_contact_that_fails_ends_no_stream(client, router, monkeypatch):
    png_of = live_module._png_of
    monkeypatch.setattr(live_module, "_png_of", lambda record: 1 / 0 if record.image_id == "0001" else png_of(record))
    Site(client, image("0001"), image("0002"))
    with zenoh.open(client_config([router])) as session:
        stream = ContactStream(session, keys.SHORE, None, stored=True)
        eventually(lambda: [change.contact.image.image_id for change in stream.poll()] == ["0002"])


def test_invalid_publications_end_no_subscription(client, router):
    site = Site(client)
    with (
        zenoh.open(client_config([router])) as session,
        CatchUpSubscriber(session, keys.shore_contact_all()) as records,
    ):
        eventually(lambda: records.poll(0.1) is None and records.is_caught_up)
        client.put(keys.shore_image("vessel-1"), b"rubbish")
        client.put(keys.shore_image("vessel-1"), wire.encode(image("0001")))  # without a number
        site.accept(image("0002"))
        found = []
        eventually(lambda: found.append(records.poll(0.1)) or found[-1] is not None)
        assert found[-1].seq == 1


def test_new_archive_is_read_from_its_first_record(client, router, monkeypatch):
    monkeypatch.setattr("sonarpost.bus.catch_up.RETRY_S", 0.05)
    Site(client, image("0001"), archive="0000000b")
    with zenoh.open(client_config([router])) as session:
        records = CatchUpSubscriber(session, keys.shore_contact_all(), "0000000a.7")
        eventually(lambda: (found := records.poll(0.1)) is not None and found.archive == "0000000b")
        records.close()
