"""`sonarpost c2 cot`: live contacts for a TAK endpoint."""

import asyncio
import hashlib
import os
import signal
import subprocess
import sys
import warnings
from configparser import ConfigParser
from pathlib import Path
from xml.etree import ElementTree as ET

import pytest
import xmlschema
from builders.common import WAIT_S, free_port
from builders.exports import Clock, contact_of, image
from builders.shore import Site
from builders.unreached_router import check_unreached_router

from sonarpost.cli.c2.watch import ContactChange
from sonarpost.cli.main import main
from sonarpost.errors import PortError
from sonarpost.extensions.tak import command
from sonarpost.extensions.tak.command import MAX_IMAGES, REFRESH_S, RETRY_S, CotService
from sonarpost.extensions.tak.data_package import PackageRefusedError, UploadedPackage, attachment_sha256


class Events:
    """Stands for the connection to a TAK server."""

    endpoint = "tcp://tak:8087"

    def __init__(self):
        self.batches = []
        self.is_down = False
        self.delivered = 0

    def send(self, events, give_up_after_s):
        assert give_up_after_s == 0
        if self.is_down:
            raise PortError("tak: down")
        self.batches.append([ET.fromstring(event) for event in events])
        self.delivered += len(events)
        return "delivered"


class Files:
    """Stands for the HTTP interface of a TAK server."""

    def __init__(self, order):
        self.is_down = False
        self.names = []
        self._order = order

    def upload(self, name, package, creator):
        if self.is_down:
            raise PortError("tak: status 500")
        self.names.append(name)
        self._order.append("upload")
        return UploadedPackage("http://tak/content", hashlib.sha256(package).hexdigest(), len(package))


def test_event_is_repeated_and_refreshed():
    sender, clock = Events(), Clock()
    service = CotService(sender, None, clock=clock)
    service.add(ContactChange(contact_of(), b"png"))
    service.add(ContactChange(contact_of(lat_deg=None), b"png"))
    times = []
    for _ in range(700):
        if service.send_due():
            times.append(clock.now_s - 100)
        clock.now_s += 1
    assert times == [0, 5, 30, REFRESH_S]
    assert {len(batch) for batch in sender.batches} == {1}
    assert sender.batches[0][0].find("detail/attachment_list") is None


def test_image_is_registered_before_its_event_is_sent():
    order = []
    sender, clock = Events(), Clock()
    files = Files(order)
    send = sender.send
    sender.send = lambda events, give_up_after_s: order.append("events") or send(events, give_up_after_s)
    service = CotService(sender, files, clock=clock)
    service.add(ContactChange(contact_of(), b"png"))
    assert service.send_due() == 1
    assert order == ["upload", "events"]
    [event, transfer] = sender.batches[0]
    assert event.find("detail/attachment_list").attrib["hashes"] == f'["{attachment_sha256(b"png")}"]'
    assert transfer.attrib["type"] == "b-f-t-r"
    clock.now_s += 5
    service.send_due()
    clock.now_s += 30
    service.send_due()
    clock.now_s += REFRESH_S
    service.send_due()
    # Clients would download the package again with every refresh.
    assert [len(batch) for batch in sender.batches] == [2, 2, 2, 1]
    assert files.names == ["uuv-1_00A7_v1.zip"]


def test_failures_are_tried_again():
    sender, clock, files = Events(), Clock(), Files([])
    sender.is_down = files.is_down = True
    service = CotService(sender, files, clock=clock)
    service.add(ContactChange(contact_of(), b"png"))
    assert service.send_due() == 0
    sender.is_down = False
    assert service.send_due() == 0  # waits before the next attempt
    clock.now_s += RETRY_S[0]
    assert service.send_due() == 1
    assert len(sender.batches[0]) == 1  # without its image
    files.is_down = False
    clock.now_s += 30
    assert service.send_due() == 1
    assert len(sender.batches[1]) == 2


def test_memory_is_limited(monkeypatch):
    monkeypatch.setattr(command, "MAX_NAMES", MAX_IMAGES + 10)
    sender, clock = Events(), Clock()
    files = Files([])
    service = CotService(sender, files, clock=clock)
    for n in range(MAX_IMAGES + 30):
        service.add(ContactChange(contact_of(f"{n:04}"), b"png"))
    assert service.send_due() == MAX_IMAGES + 10
    assert len(files.names) == MAX_IMAGES


def test_contacts_and_images_have_places_by_vessel(monkeypatch):
    monkeypatch.setattr(command, "MAX_NAMES", MAX_IMAGES)
    sender, files = Events(), Files([])
    service = CotService(sender, files, clock=Clock())
    service.add(ContactChange(contact_of("0000"), b"png"))
    for n in range(MAX_IMAGES + 30):
        service.add(ContactChange(contact_of(f"{n:04}", "vessel-2"), b"png"))
    service.send_due()
    # The vessel with one contact is first, and has kept its place and its image.
    assert sender.batches[0][0].attrib["uid"].endswith("0000")
    assert len(files.names) == MAX_IMAGES


def test_refused_package_delays_no_other():
    sender, files = Events(), Files([])
    upload = files.upload

    def refuse(name, package, creator):
        if "0001" in name:
            raise PackageRefusedError("status 500")
        return upload(name, package, creator)

    files.upload = refuse
    service = CotService(sender, files, clock=Clock())
    for n in range(1, 4):
        service.add(ContactChange(contact_of(f"{n:04}"), b"png"))
    assert service.send_due() == 3
    assert [("0002" in name, "0003" in name) for name in files.names] == [(True, False), (False, True)]


def test_contact_that_fails_ends_no_batch(monkeypatch):
    cot_event = command.cot_event
    monkeypatch.setattr(
        command,
        "cot_event",
        lambda contact, *rest: 1 / 0 if contact.image.image_id == "0001" else cot_event(contact, *rest),
    )
    sender = Events()
    service = CotService(sender, None, clock=Clock())
    for n in (1, 2):
        service.add(ContactChange(contact_of(f"{n:04}"), None))
    assert service.send_due() == 2
    assert [[event.attrib["uid"][-4:] for event in batch] for batch in sender.batches] == [["0002"]]


@pytest.mark.system
def test_cot_command_sends_events_across_a_restart_of_the_server(router, client):
    """pytak reads the events; the schema of the base event accepts them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it can use aiohttp for enrolment, which this test does not need
        import pytak

    site = Site(client, image("0001"))
    port = free_port()
    received = []

    async def read(until):
        """Accept one connection, and read events with pytak until `until` was received."""
        done = asyncio.Event()

        async def accept(reader, writer):
            config = ConfigParser()
            config["tak"] = {}
            queue = asyncio.Queue()
            worker = pytak.RXWorker(queue, config["tak"], reader)
            # Each batch has a connection of its own: the event can be in the next one.
            while not done.is_set() and not reader.at_eof():
                await worker.run_once()
                while not queue.empty():
                    received.append(ET.fromstring(queue.get_nowait()))
                if any(event.attrib["uid"].endswith(until) for event in received):
                    done.set()
            writer.close()

        async with await asyncio.start_server(accept, "127.0.0.1", port):
            await asyncio.wait_for(done.wait(), WAIT_S)

    arguments = ["c2", "cot", f"tcp://127.0.0.1:{port}", "--router", router, "--stored"]
    process = subprocess.Popen([sys.executable, "-m", "sonarpost.cli.main", *arguments], env=dict(os.environ))
    try:
        asyncio.run(read("0001"))
        site.accept(image("0002"))
        asyncio.run(read("0002"))
        process.send_signal(signal.SIGINT)
        assert process.wait() == 0
    finally:
        process.kill()
        process.wait()
    schema = xmlschema.XMLSchema(Path(__file__).with_name("cot_event.xsd"))
    for event in received:
        schema.validate(event)


def test_cot_command_rejects_invalid_addresses(capsys):
    assert main(["c2", "cot", "http://tak"]) == 2
    assert "CoT endpoint" in capsys.readouterr().err
    assert main(["c2", "cot", "tcp://tak:8087", "--tak-api", "tak"]) == 2
    assert "TAK server" in capsys.readouterr().err


def test_unreached_router_is_reported():
    check_unreached_router("c2 cot udp://127.0.0.1:9")
