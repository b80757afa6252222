"""Codebooks that a shore site lacks: fetched from the vessel by their identity, refused if they have another one."""

import threading

import msgpack
import pytest
from builders.common import WAIT_S, eventually
from builders.vessel_frames import CONTACT

from sonarpost import keys, wire
from sonarpost.archive import codebook_transfer
from sonarpost.archive.decoder import Decoder
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook, to_bytes
from sonarpost.link.receiver import ImageUpdate, received_image
from sonarpost.messages import CodedImage, ReconstructedImage
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

VESSEL = "vessel-1"
CODEBOOK = open_codebook("nominal-10")
MODEL = CODEBOOK.tiles.identity[:32]
KEY = keys.codebook(VESSEL, MODEL)


@pytest.fixture(scope="module")
def image(texture):
    """An image of the codebook nominal-10, as the vessel has decoded it, and the record of the decompressor."""
    stream = default_registry().create("vq", CodecResources(CODEBOOK.tiles)).encode(texture())
    size = len(stream)
    update = ImageUpdate(3, "000A", 1, CONTACT, stream, (), True, size, size, 4, 0, 1.7e9, 1.7e9)
    decoder, received = Decoder(("nominal-10",)), received_image(update, VESSEL, "uuv-1", authenticated=True)
    decoded = decoder.decode(received)
    return decoded, decoder.coded_image(received, decoded)


@pytest.fixture
def start_c2(runner, platform, tmp_path, monkeypatch):
    """c2 without that codebook."""
    monkeypatch.setattr(codebook_transfer, "RETRY_S", 0.2)
    monkeypatch.setattr(codebook_transfer, "MAX_RETRY_S", 0.2)
    monkeypatch.setattr(codebook_transfer, "REPLY_TIMEOUT_S", 2.0)
    config = C2Config(out_dir=tmp_path / "shore", codebooks=("nominal-20",))
    return lambda: runner.start(C2Service(platform("shore-1"), config))


@pytest.fixture
def send(runner, platform):
    """Send a coded image to the relay."""
    runner.start(RelayService(platform(VESSEL), RelayConfig()))
    peer = runner.peer(VESSEL, "decompressor")
    return lambda coded: peer.send(keys.image_coded(VESSEL), "relay", coded)


def test_image_waits_for_its_codebook_and_is_decoded(image, start_c2, send, client, watch, refused):
    decoded, coded = image
    at_shore = watch(keys.shore_image(VESSEL))
    c2 = start_c2()
    send(coded)
    eventually(lambda: f"1 images of {VESSEL} wait for codebook {MODEL}" in c2.health().detail)
    eventually(lambda: f"{KEY}: reply: got 'none', expected a piece" in c2.health().detail)
    assert at_shore == []
    codebook_transfer.declare_codebooks(client, VESSEL, Decoder(("nominal-10",)))
    eventually(lambda: at_shore)
    assert wire.decode(ReconstructedImage, at_shore[0].payload.to_bytes(), "") == decoded
    eventually(lambda: c2.health().gauges["images_undecoded"] == 0.0)
    assert c2.health().detail == ""
    assert refused(c2) == []


def piece(data, size=None):
    return msgpack.packb({"v": 1, "size": len(data) if size is None else size, "data": data})


def test_hostile_replies_and_another_codebook_are_refused(image, start_c2, send, client, watch):
    other = to_bytes(open_codebook("nominal-20"))
    replies = [
        (lambda _: piece(b"x" * 32769), "data: got"),
        (lambda _: piece(b"x" * 100), "magic: got"),
        (lambda _: piece(b"xy", 1), "data: got '2 bytes', expected 1 bytes from offset 0"),
        (lambda _: piece(b"x", 16 * 1024 * 1024 + 1), "size: got 16777217"),
        (lambda _: piece(b"", 10), "data: got"),
        (lambda _: piece(b"x", 10), "data: got '1 bytes', expected 10 bytes from offset 0"),
        (lambda _: b"\xc1", "payload: got"),
        (lambda offset: piece(other[offset : offset + 32768], len(other)), f"expected {MODEL}…, which was requested"),
    ]
    at_shore, current = watch(keys.shore_image(VESSEL)), [replies[0][0]]

    def on_query(query):
        with query:
            query.reply(query.key_expr, current[0](int(query.parameters.get("offset"))))

    client.declare_queryable(keys.codebook_all(VESSEL), on_query)
    c2 = start_c2()
    send(image[1])
    for reply, reason in replies:
        current[0] = reply
        eventually(lambda reason=reason: reason in c2.health().detail, what=reason)
    assert at_shore == []
    assert list((c2.platform.state_dir / "codebooks").rglob("*.tiles")) == []


def test_vessel_has_a_limited_number_of_codebooks(image, start_c2, send, client):
    c2 = start_c2()
    folder = c2.platform.state_dir / "codebooks" / VESSEL
    folder.mkdir(parents=True)
    for number in range(codebook_transfer.MAX_CODEBOOKS):
        (folder / f"{number:032x}.tiles").write_bytes(b"")
    codebook_transfer.declare_codebooks(client, VESSEL, Decoder(("nominal-10",)))
    send(image[1])
    eventually(lambda: f"codebooks of {VESSEL}: got '8 files', expected fewer" in c2.health().detail)


def test_invalid_offset_and_unknown_codebook_are_errors(client):
    codebook_transfer.declare_codebooks(client, VESSEL, Decoder(("nominal-10",)))
    offsets = ("-1", "x", "9" * 30, str(len(to_bytes(CODEBOOK))))
    for selector in (*(f"{KEY}?offset={offset}" for offset in offsets), keys.codebook(VESSEL, "0" * 32)):
        [reply] = client.get(selector, timeout=WAIT_S)
        assert reply.ok is None


def test_images_that_wait_are_limited(image, start_c2, send, refused, monkeypatch):
    monkeypatch.setattr("sonarpost.services.c2.decoding.MAX_WAITING", 2)
    c2 = start_c2()
    for number in range(3):
        assert isinstance(image[1], CodedImage)
        send(image[1].model_copy(update={"image_id": f"000{number}"}))
    eventually(lambda: len(refused(c2)) == 1)
    assert MODEL in refused(c2)[0][1]
    eventually(lambda: c2.health().gauges["images_undecoded"] == 2.0)


SIZE = 16 * 1024 * 1024


def silent(key, _):
    raise codebook_transfer._NoReplyError(key, "reply", "none", "a piece of the codebook")


@pytest.mark.parametrize(
    ("hostile", "queries"),
    [
        (lambda *_: {"v": 1, "size": SIZE, "data": b"x"}, 1),
        (silent, 1),
        (lambda _, offset: {"v": 1, "size": SIZE, "data": bytes(min(32768, SIZE - offset))}, None),
    ],
    ids=["one byte a piece", "silent", "16 MB"],
)
def test_vessel_does_not_delay_the_codebook_of_another(tmp_path, monkeypatch, hostile, queries):
    data, queried, stopping = to_bytes(CODEBOOK), [], threading.Event()

    def query(_session, key, offset):
        vessel = key.split("/")[2]
        queried.append(vessel)
        fields = (
            hostile(key, offset)
            if vessel == "vessel-2"
            else {"v": 1, "size": len(data), "data": data[offset : offset + 32768]}
        )
        return codebook_transfer._Piece.model_validate(fields)

    def added(vessel):
        stored.append(vessel)
        stopping.set()

    stored = []
    monkeypatch.setattr(codebook_transfer, "_query", query)
    wanted = {VESSEL: [MODEL], "vessel-2": [f"{number:032x}" for number in range(40)]}
    fetcher = codebook_transfer.CodebookFetcher(tmp_path, lambda: wanted, added, stopping)
    fetcher.run(None)
    pieces = -(-len(data) // 32768)
    assert stored == [VESSEL]
    assert queried.count(VESSEL) == pieces
    # One query of the other vessel for each of this one at most, and none while it pauses.
    assert queried.count("vessel-2") <= (pieces + 1 if queries is None else queries)
    assert len(list((tmp_path / "vessel-2").glob("*"))) <= 1 if (tmp_path / "vessel-2").exists() else True
    assert [path.name for path in (tmp_path / VESSEL).iterdir()] == [f"{MODEL}.tiles"]


def test_incomplete_codebook_is_kept_while_the_vessel_is_silent(tmp_path, monkeypatch):
    data, stopping, offsets, failures = to_bytes(CODEBOOK), threading.Event(), [], []
    monkeypatch.setattr(codebook_transfer, "RETRY_S", 0.0)

    def query(_session, key, offset):
        offsets.append(offset)
        failures.append(fetcher._vessels[VESSEL].failures)
        if len(offsets) % 2 == 0:
            silent(key, offset)
        return codebook_transfer._Piece(v=1, size=len(data), data=data[offset : offset + 32768])

    fetcher = codebook_transfer.CodebookFetcher(
        tmp_path, lambda: {VESSEL: [MODEL, "f" * 32]}, lambda _: stopping.set(), stopping
    )
    monkeypatch.setattr(codebook_transfer, "_query", query)
    fetcher.run(None)
    assert offsets[::2] == list(range(0, len(data), 32768))
    assert len(offsets) > 4
    assert max(failures) == 1  # each pause is the first one again


def test_folder_that_cannot_be_used_concerns_its_vessel_only(tmp_path, monkeypatch):
    data, stopping = to_bytes(CODEBOOK), threading.Event()
    (tmp_path / "vessel-0").write_bytes(b"not a folder")

    def query(_session, _key, offset):
        return codebook_transfer._Piece(v=1, size=len(data), data=data[offset : offset + 32768])

    monkeypatch.setattr(codebook_transfer, "_query", query)
    wanted = {"vessel-0": [MODEL], VESSEL: [MODEL]}
    fetcher = codebook_transfer.CodebookFetcher(tmp_path, lambda: wanted, lambda _: stopping.set(), stopping)
    fetcher.run(None)
    assert (tmp_path / VESSEL / f"{MODEL}.tiles").is_file()
    assert "vessel-0" in fetcher.faults[MODEL, "vessel-0"]
