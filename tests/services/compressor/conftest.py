"""Fixtures of the compressor tests: the service, its neighbours in the chain, and codecs to compare with."""

from __future__ import annotations

import pytest
from builders.records import command_record

from sonarpost import keys
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.codec.vq.codec import IndexPacking
from sonarpost.messages import EncodedImage
from sonarpost.services.compressor.config import CompressorConfig
from sonarpost.services.compressor.service import CompressorService

OUT = keys.image_encoded("uuv-1")


@pytest.fixture
def start_service(runner, platform):
    def start(**options):
        options = {"codec": "vq", **options}  # fast, and of fixed length
        return runner.start(CompressorService(platform("uuv-1"), CompressorConfig(**options)))

    return start


@pytest.fixture
def modem(runner):
    return runner.peer("uuv-1", "uuv_modem", {OUT: EncodedImage})


@pytest.fixture
def atd(runner):
    return runner.peer("uuv-1", "atd_stub")


@pytest.fixture
def send_command(runner):
    """Send commands as uuv_modem does, each with an identifier of its own."""
    uuv_modem = runner.peer("uuv-1", "vehicle_commands")
    sent = []

    def send(kind, image_id):
        sent.append(kind)
        record = command_record(kind, image_id).model_copy(update={"command_id": f"c-{len(sent)}"})
        uuv_modem.send(keys.command("uuv-1", kind), "compressor", record)

    return send


@pytest.fixture(scope="session")
def vq():
    tiles = open_codebook("nominal-10").tiles
    return default_registry().create("vq", CodecResources(tiles, IndexPacking.BITS14))


@pytest.fixture(scope="session")
def emb():
    return default_registry().create("emb", CodecResources())
