"""Fixtures of the compressor tests: the service, its neighbours in the chain, and codecs to compare with."""

from itertools import count

import pytest
from builders.common import eventually
from builders.records import command_record

from sonarpost import keys
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.link.downlink import messages as dl
from sonarpost.messages import EncodedImage
from sonarpost.services.compressor.config import CompressorConfig
from sonarpost.services.compressor.service import CompressorService
from sonarpost.services.op_modem.vessel_endpoint import message_of
from sonarpost.services.uuv_modem.config import UuvModemConfig
from sonarpost.services.uuv_modem.received_commands import ReceivedCommands

IN, OUT = keys.contact_detected("uuv-1"), keys.image_encoded("uuv-1")


@pytest.fixture
def start_service(runner, platform):
    def start(**options):
        options = {"codec": "vq", **options}  # fast, and of fixed length
        return runner.start(CompressorService(platform("uuv-1"), CompressorConfig(**options)))

    return start


@pytest.fixture
def restart(runner, start_service):
    """Stop a service after its images were delivered, and start another one."""

    def begin(service, **options):
        eventually(lambda: service.store.outbox_depth() == 0)
        runner.stop(service)
        return start_service(**options)

    return begin


@pytest.fixture
def modem(runner):
    return runner.peer("uuv-1", "uuv_modem", {OUT: EncodedImage})


@pytest.fixture
def atd(runner):
    return runner.peer("uuv-1", "atd_stub")


@pytest.fixture
def encoded(atd, modem):
    """Send snippets to the service, and return the images that it makes of them."""

    def encode(*snippets):
        before = len(modem.received)
        atd.send(IN, "compressor", *snippets)
        eventually(lambda: len(modem.received) == before + len(snippets))
        return modem.received[before:]

    return encode


@pytest.fixture
def send_command(runner):
    """Send commands as uuv_modem does, each with an identifier of its own."""
    uuv_modem = runner.peer("uuv-1", "vehicle_commands")
    numbers = count(1)

    def send(kind, image_id, **fields):
        record = command_record(kind, image_id, **fields).model_copy(update={"command_id": f"c-{next(numbers)}"})
        uuv_modem.send(keys.command("uuv-1", kind), "compressor", record)

    return send


@pytest.fixture
def answer(send_command, modem):
    """Send a command and return the image that answers it."""

    def ask(kind, image_id, **fields):
        before = len(modem.received)
        send_command(kind, image_id, **fields)
        eventually(lambda: len(modem.received) == before + 1)
        return modem.received[before]

    return ask


@pytest.fixture
def command_over_the_link(runner, modem):
    """Send a command as the vessel packs it and uuv_modem unpacks it; return the image that answers it."""

    def send(kind, image_id):
        before = len(modem.received)
        downlink_bytes = dl.pack(message_of(command_record(kind, image_id), 7))
        commands = ReceivedCommands("uuv-1", UuvModemConfig(port="unused"))
        outcome, received = commands.accept(1, dl.unpack(downlink_bytes), image_id)
        assert (outcome, received.consumers) == (dl.CommandOutcome.ACCEPTED, ("compressor",))
        runner.peer("uuv-1", "link").send(received.key, "compressor", received.record)
        eventually(lambda: len(modem.received) == before + 1)
        return modem.received[before]

    return send


@pytest.fixture(scope="session")
def vq():
    tiles = open_codebook("nominal-10").tiles
    return default_registry().create("vq", CodecResources(tiles, IndexPacking.BITS14))


@pytest.fixture(scope="session")
def emb():
    return default_registry().create("emb", CodecResources())
