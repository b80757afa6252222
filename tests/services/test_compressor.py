"""compressor: one stream a snippet, identifiers that are never given twice, bad pictures apart."""

from __future__ import annotations

from itertools import pairwise

import msgpack
import numpy as np
import pytest
from conftest import eventually

from services.atd_stub.config import AtdStubConfig
from services.atd_stub.record import of_detection
from services.atd_stub.seam import Origin
from services.compressor.config import CompressorConfig
from services.compressor.service import IMAGE_IDS, CompressorService
from services.compressor.wide import wider
from services.op_modem.station import order_of
from services.uuv_modem.config import UuvModemConfig
from services.uuv_modem.orders import OrderBook
from sonarpost import keys, wire
from sonarpost.catalogue.store import open_catalogue
from sonarpost.codec.interface import StreamHeader, to_uint8
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq import IndexPacking
from sonarpost.detect.contacts import detect
from sonarpost.errors import CatalogueError, ConfigError
from sonarpost.link import downlink as dl
from sonarpost.link.paper_format import format_image_id, is_image_id
from sonarpost.messages import Command, Contact, EncodedImage, Raster, Snippet
from sonarpost.sim.survey import SurveySpec, simulate_survey

IN, OUT = keys.contact_detected("uuv-1"), keys.image_encoded("uuv-1")


@pytest.fixture
def begin(crew, platform):
    def start(**options):
        return crew.start(CompressorService(platform("uuv-1"), CompressorConfig(**options)))

    return start


@pytest.fixture
def modem(crew):
    return crew.neighbour("uuv-1", "uuv_modem", {OUT: EncodedImage})


@pytest.fixture
def atd(crew):
    return crew.neighbour("uuv-1", "atd_stub")


@pytest.fixture(scope="session")
def vq():
    tiles = open_catalogue("nominal-10").tiles
    return default_registry().create("vq", CodecResources(tiles, IndexPacking.BITS14))


def test_a_snippet_becomes_a_stream_with_its_contact(begin, atd, modem, snippet, vq, is_told, watch):
    seen = watch(OUT)
    service = begin()
    sent = snippet("c1")
    atd.owe(IN, "compressor", sent)
    eventually(lambda: len(modem.got) == 1)
    image = modem.got[0]
    assert image.contact == sent.contact
    assert (image.vehicle_id, image.codec, image.model) == ("uuv-1", "vq", vq.model_hash)
    assert (image.height_px, image.width_px, image.original_sha256) == (40, 60, sent.picture.sha256)
    assert image.stream == vq.encode(sent.picture.to_array())
    assert is_image_id(image.image_id)
    eventually(lambda: atd.store.outbox_depth() == 0)
    # The header, and 14 bits for each tile of 10 x 10 px.
    size = StreamHeader.unpack(image.stream).size + 4 * 6 * 14 // 8
    eventually(lambda: service.health().counters == {"records_handled": 1, "images_encoded": 1, "bytes_encoded": size})
    eventually(lambda: len(seen) == 1, what="the copy for watchers")
    assert msgpack.unpackb(seen[0].payload.to_bytes())["image_id"] == image.image_id
    is_told(service)


def test_sixteen_bits_are_mapped_over_their_own_range(begin, atd, modem, snippet, vq):
    begin()
    deep = snippet("deep", dtype=np.uint16)
    assert deep.picture.bits == 16
    atd.owe(IN, "compressor", deep)
    eventually(lambda: len(modem.got) == 1)
    assert modem.got[0].stream == vq.encode(to_uint8(deep.picture.to_array()))
    assert modem.got[0].original_sha256 == deep.picture.sha256


@pytest.mark.parametrize(
    ("height_px", "width_px", "said"),
    [(15, 60, "height_px: got 15"), (60, 15, "width_px: got 15"), (513, 40, "height_px: got 513")],
)
def test_a_picture_of_the_wrong_size_is_kept_apart(height_px, width_px, said, begin, atd, modem, snippet, refused):
    service = begin()
    atd.owe(IN, "compressor", snippet("bad", height_px, width_px), snippet("good"))
    eventually(lambda: [i.contact.contact_id for i in modem.got] == ["good"])
    [(key, reason)] = refused(service)
    assert key == IN
    assert said in reason
    assert "expected 16..512" in reason
    health = service.health()
    assert (health.state, health.counters["records_refused"], health.gauges["refused"]) == ("ok", 1, 1.0)


def test_a_budget_that_cannot_be_met_is_said(begin, atd, modem, snippet, refused):
    service = begin(budget_bytes=9)
    atd.owe(IN, "compressor", snippet("large"))
    eventually(lambda: len(refused(service)) == 1)
    assert "budget" in refused(service)[0][1]
    assert not service.failed
    assert modem.got == []


@pytest.mark.parametrize(
    "spoil",
    [
        lambda fields: b"",
        lambda fields: b"\xc1",
        lambda fields: msgpack.packb(list(fields)),
        lambda fields: msgpack.packb(fields | {"v": 2}),
        lambda fields: msgpack.packb(fields | {"type": "decision"}),
        lambda fields: msgpack.packb(fields | {"contact": None}),
        lambda fields: msgpack.packb(fields | {"picture": fields["picture"] | {"data": b"short"}}),
        lambda fields: msgpack.packb(fields | {"picture": fields["picture"] | {"height_px": -1}}),
    ],
)
def test_a_payload_that_is_no_snippet_is_refused_and_the_next_one_taken(spoil, begin, atd, modem, snippet, refused):
    service = begin()
    atd.owe_bytes(IN, "compressor", spoil(msgpack.unpackb(wire.encode(snippet("spoilt")))))
    atd.owe(IN, "compressor", snippet("good"))
    eventually(lambda: [i.contact.contact_id for i in modem.got] == ["good"])
    [(key, reason)] = refused(service)
    assert key == IN
    assert IN in reason
    assert "expected" in reason
    # The producer has it too, with what was said of it.
    eventually(lambda: refused(atd) == [(IN, reason)])
    assert service.health().counters["records_refused"] == 1


def test_a_plain_publication_is_encoded_too(begin, modem, snippet, publish):
    begin()
    publish(IN, wire.encode(snippet("from somebody's own detector")))
    eventually(lambda: len(modem.got) == 1)


def test_identifiers_go_on_over_restarts(begin, crew, atd, modem, snippet):
    for turn in range(3):
        service = begin()
        atd.owe(IN, "compressor", *(snippet(f"{turn}-{n}") for n in range(4)))
        eventually(lambda turn=turn: len(modem.got) == 4 * (turn + 1))
        crew.stop(service)
    first = int(modem.got[0].image_id, 36)
    assert [i.image_id for i in modem.got] == [format_image_id(first + n) for n in range(12)]
    assert [i.contact.contact_id for i in modem.got] == [f"{t}-{n}" for t in range(3) for n in range(4)]


def test_the_last_identifier_is_followed_by_the_first(begin, crew, platform, atd, modem, snippet):
    service = begin()
    with service.store.transaction() as tx:
        tx.put_state("next_image", str(IMAGE_IDS).encode())
    atd.owe(IN, "compressor", snippet("a"), snippet("b"))
    eventually(lambda: [i.image_id for i in modem.got] == ["1EKF", "0001"])


def test_a_wiped_vehicle_does_not_begin_where_its_last_mission_did(crew, platform, tmp_path):
    starts = set()
    for number in range(4):
        wiped = platform("uuv-1").model_copy(update={"state_dir": tmp_path / str(number)})
        service = CompressorService(wiped, CompressorConfig())
        starts.add(service._next_number())
        service.store.close()
    assert len(starts) == 4


def test_what_was_encoded_before_a_stop_is_sent_after_it(begin, crew, atd, snippet):
    service = begin()
    atd.owe(IN, "compressor", snippet("a"), snippet("b"))
    eventually(lambda: service.store.outbox_depth() == 2)
    crew.stop(service)
    begin()
    late = crew.neighbour("uuv-1", "uuv_modem", {OUT: EncodedImage})
    eventually(lambda: [i.contact.contact_id for i in late.got] == ["a", "b"])


def test_what_was_accepted_before_a_stop_is_encoded_after_it(begin, platform, modem, snippet):
    idle = CompressorService(platform("uuv-1"), CompressorConfig())
    with idle.store.transaction() as tx:
        tx.accept(IN, wire.encode(snippet("waiting")))
    idle.store.close()
    begin()
    eventually(lambda: [i.contact.contact_id for i in modem.got] == ["waiting"])


@pytest.mark.parametrize("packing", list(IndexPacking))
def test_every_packing_is_what_the_configuration_says(packing, begin, atd, modem, snippet):
    begin(packing=packing)
    atd.owe(IN, "compressor", snippet("c"))
    eventually(lambda: len(modem.got) == 1)
    assert modem.got[0].stream[0] == packing.codec_id


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"catalogue": "/nowhere/own.tiles"}, CatalogueError, "/nowhere/own.tiles"),
        ({"catalogue": "nominal-11"}, CatalogueError, "nominal-11"),
        ({"codec": "jpeg-of-the-future"}, ConfigError, "one of"),
    ],
)
def test_a_wrong_configuration_is_said_before_anything_is_opened(options, error, said, platform):
    with pytest.raises(error, match=said):
        CompressorService(platform("uuv-1"), CompressorConfig(**options))
    assert not (platform("uuv-1").state_dir / "compressor.db").exists()


def test_a_damaged_catalogue_is_named(platform, tmp_path):
    path = tmp_path / "own.tiles"
    path.write_bytes(b"SPTILES\n" + bytes(100))
    with pytest.raises(CatalogueError, match=r"own\.tiles"):
        CompressorService(platform("uuv-1"), CompressorConfig(catalogue=str(path)))


def test_a_full_disk_leaves_the_snippet_with_its_sender(begin, atd, modem, snippet):
    service = begin()
    service.store._db.execute("PRAGMA max_page_count=1")
    atd.owe(IN, "compressor", snippet("late", 200, 200))
    eventually(lambda: service.health().state == "degraded")
    assert atd.store.outbox_depth() == 1
    service.store._db.execute("PRAGMA max_page_count=1000000")
    eventually(lambda: len(modem.got) == 1)
    eventually(lambda: service.health().state == "ok")


def test_the_contact_arrives_as_it_was(begin, atd, modem, texture):
    begin()
    contact = Contact(
        contact_id="full", vehicle_id="uuv-1", lat_deg=56.1, lon_deg=-5.2, atd_confidence=1.5, ping_number=7
    )
    atd.owe(IN, "compressor", Snippet(contact=contact, picture=Raster.from_array(texture())))
    eventually(lambda: len(modem.got) == 1)
    assert modem.got[0].contact == contact


def command(kind, image_id):
    return Command(
        command_id=f"{kind}-{image_id}",
        kind=kind,
        vehicle_id="uuv-1",
        image_id=image_id,
        issued_by="modem 1",
        issued_utc_s=1476262800.0,
    )


def test_a_picture_that_is_asked_for_again_is_given_again_until_it_is_forgotten(begin, crew, atd, modem, snippet):
    service = begin(keep_pictures=2)
    uuv_modem = crew.neighbour("uuv-1", "orders")
    atd.owe(IN, "compressor", *[snippet(f"c{n}") for n in range(3)])
    eventually(lambda: len(modem.got) == 3)
    first, _, third = modem.got
    uuv_modem.owe(keys.command("uuv-1", "resend"), "compressor", command("resend", third.image_id))
    uuv_modem.owe(keys.command("uuv-1", "resend"), "compressor", command("resend", first.image_id))
    eventually(lambda: service.health().counters.get("commands_unknown_image") == 1)
    eventually(lambda: len(modem.got) == 4)
    assert modem.got[3] == third


@pytest.fixture(scope="session")
def emb():
    return default_registry().create("emb", CodecResources())


def refine(uuv_modem, modem, times):
    """Ask for the first picture to be refined so many times; return its streams."""
    eventually(lambda: len(modem.got) == 1)
    for n in range(times):
        again = command("refine", modem.got[0].image_id).model_copy(update={"command_id": f"again-{n}"})
        uuv_modem.owe(keys.command("uuv-1", "refine"), "compressor", again)
        eventually(lambda wanted=n + 2: len(modem.got) == wanted)
    assert {image.image_id for image in modem.got} == {modem.got[0].image_id}
    return [image.stream for image in modem.got]


@pytest.mark.parametrize("budget_bytes", [100, 101, 256])
def test_refining_gives_twice_the_stream_with_all_that_was_given(budget_bytes, begin, crew, atd, modem, snippet, emb):
    service = begin(codec="emb", budget_bytes=budget_bytes)
    picture = snippet("c1", 64, 64)
    atd.owe(IN, "compressor", picture)
    streams = refine(crew.neighbour("uuv-1", "orders"), modem, times=3)
    assert len(streams[0]) == budget_bytes
    for shorter, longer in pairwise(streams):
        assert longer.startswith(shorter)
        assert len(longer) >= 1.9 * len(shorter)
    eventually(lambda: service.health().counters.get("images_refined") == 3)
    truth = picture.picture.to_array().astype(float)
    errors = [float(((emb.decode(stream).image - truth) ** 2).mean()) for stream in streams]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.8 * errors[0]


def test_a_stream_goes_on_beyond_its_budget_for_the_vessel_to_ask_for(begin, crew, atd, modem, snippet):
    begin(codec="emb", budget_bytes=200, refine_bytes=900)
    atd.owe(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.got) == 1)
    begun = modem.got[0].stream
    assert 850 < len(begun) <= 900


def test_resending_gives_the_same_stream(begin, crew, atd, modem, snippet):
    begin(codec="emb", budget_bytes=120)
    atd.owe(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.got) == 1)
    orders = crew.neighbour("uuv-1", "orders")
    orders.owe(keys.command("uuv-1", "resend"), "compressor", command("resend", modem.got[0].image_id))
    eventually(lambda: len(modem.got) == 2)
    assert modem.got[1] == modem.got[0]


def test_where_no_longer_stream_continues_the_first_the_same_is_given_again(begin, crew, atd, modem, snippet):
    service = begin()
    uuv_modem = crew.neighbour("uuv-1", "orders")
    atd.owe(IN, "compressor", snippet("c1"))
    eventually(lambda: len(modem.got) == 1)
    uuv_modem.owe(keys.command("uuv-1", "refine"), "compressor", command("refine", modem.got[0].image_id))
    eventually(lambda: len(modem.got) == 2)
    assert modem.got[1] == modem.got[0]
    assert "images_refined" not in service.health().counters


def test_a_picture_of_before_the_codec_was_changed_is_given_as_it_was(begin, crew, atd, modem, snippet):
    first = begin(codec="emb", budget_bytes=120)
    atd.owe(IN, "compressor", snippet("c1", 64, 64))
    eventually(lambda: len(modem.got) == 1)
    eventually(lambda: first.store.outbox_depth() == 0)
    crew.stop(first)
    begin(codec="vq")
    [_, again] = refine(crew.neighbour("uuv-1", "orders"), modem, times=1)
    assert again.startswith(modem.got[0].stream)
    assert modem.got[1].codec == "emb"


# More of the seabed around


@pytest.fixture
def with_wide(snippet):
    """Snippets of which the seabed around is known, pixels of 0.05 m x 0.1 m."""

    def make(contact_id, seed=1, **changes):
        sizes = {"pixel_along_m": 0.05, "pixel_across_m": 0.1}
        contact = Contact(contact_id=contact_id, vehicle_id="uuv-1", **(sizes | changes))
        wide = snippet("around", seed=seed + 100).picture
        return Snippet(contact=contact, picture=snippet(contact_id, seed=seed).picture, source="line", wide=wide)

    return make


@pytest.fixture
def ask(crew):
    """Asks for a picture as uuv_modem does; each time by an order of its own."""
    orders = crew.neighbour("uuv-1", "orders")
    asked = []

    def give(kind, image_id):
        asked.append(kind)
        record = command(kind, image_id).model_copy(update={"command_id": f"c-{len(asked)}"})
        orders.owe(keys.command("uuv-1", kind), "compressor", record)

    return give


def test_wider_gives_more_seabed_as_a_picture_of_its_own(begin, ask, atd, modem, with_wide, vq):
    service = begin()
    sent = with_wide("c1")
    atd.owe(IN, "compressor", sent)
    eventually(lambda: len(modem.got) == 1)
    ask("wider", modem.got[0].image_id)
    eventually(lambda: len(modem.got) == 2)
    first, wide = modem.got
    assert int(wide.image_id, 36) == int(first.image_id, 36) + 1
    assert wide.contact == sent.contact.model_copy(update={"pixel_along_m": 0.1, "pixel_across_m": 0.2})
    assert wide.stream == vq.encode(sent.wide.to_array())
    assert wide.original_sha256 == sent.wide.sha256
    counters = service.health().counters
    assert (counters["images_encoded"], counters["images_widened"]) == (2, 1)


def test_wider_of_a_real_detection_shows_twice_the_ground_from_the_vessels_order_on(begin, crew, atd, modem, emb):
    survey = simulate_survey(SurveySpec(seed=1, pings=400, samples=1024, clutter=0)).survey
    config = AtdStubConfig()
    origin = Origin("ab" * 32, "line-7.xtf", "line-7")
    # Away from the recording's ends, where the wide picture would be shifted.
    found = next(each for each in detect(survey) if 80 <= each.ping_index < 320 and 150 <= each.sample < 850)
    sent = of_detection(survey, found, origin, "uuv-1", config)
    begin(codec="emb", budget_bytes=4000)
    atd.owe(IN, "compressor", sent)
    eventually(lambda: len(modem.got) == 1)
    first = modem.got[0]
    # On the vessel a command, in the water bytes, on the vehicle a command again.
    in_the_water = dl.pack(order_of(command("wider", first.image_id), 7))
    outcome, handed = OrderBook("uuv-1", UuvModemConfig(port="unused")).take(1, dl.unpack(in_the_water), first.image_id)
    assert (outcome, handed.consumers) == (dl.Outcome.TAKEN, ("compressor",))
    crew.neighbour("uuv-1", "orders").owe(handed.key, "compressor", handed.record)
    eventually(lambda: len(modem.got) == 2)
    wide = modem.got[1]
    seen = {image.image_id: emb.decode(image.stream).image.astype(float) for image in (first, wide)}
    around, near = seen[wide.image_id], seen[first.image_id]
    assert around.shape == near.shape == (80, 140)
    assert wide.contact.pixel_along_m == 2 * first.contact.pixel_along_m
    assert wide.contact.pixel_across_m == 2 * first.contact.pixel_across_m
    # What the first picture shows is the middle of the wide one, at half the size; nowhere else is it like it.
    small = near.reshape(40, 2, 70, 2).mean(axis=(1, 3))
    likeness = {
        (row, column): np.corrcoef(small.ravel(), around[row : row + 40, column : column + 70].ravel())[0, 1]
        for row in range(0, 41, 5)
        for column in range(0, 71, 5)
    }
    assert max(likeness, key=likeness.__getitem__) == (20, 35)
    assert likeness[20, 35] > 0.8


def test_wider_asked_again_gives_the_same_picture_again(begin, crew, ask, atd, modem, with_wide):
    service = begin()
    atd.owe(IN, "compressor", with_wide("c1"), with_wide("c2", seed=2))
    eventually(lambda: len(modem.got) == 2)
    ask("wider", modem.got[0].image_id)
    eventually(lambda: len(modem.got) == 3)
    ask("refine", modem.got[0].image_id)  # what is kept of it is written anew, and still knows its wide one
    eventually(lambda: len(modem.got) == 4)
    crew.stop(service)
    service = begin()
    ask("wider", modem.got[0].image_id)
    eventually(lambda: len(modem.got) == 5)
    assert modem.got[4] == modem.got[2]
    assert "images_encoded" not in service.health().counters


def test_a_wider_picture_that_is_forgotten_is_made_again(begin, ask, atd, modem, with_wide):
    begin(codec="emb", budget_bytes=120, keep_pictures=2)
    atd.owe(IN, "compressor", with_wide("c1"))
    eventually(lambda: len(modem.got) == 1)
    first = modem.got[0].image_id
    ask("wider", first)
    eventually(lambda: len(modem.got) == 2)
    ask("refine", first)  # now the wide one has been kept longest
    eventually(lambda: len(modem.got) == 3)
    atd.owe(IN, "compressor", with_wide("c2", seed=2))
    eventually(lambda: len(modem.got) == 4)
    ask("wider", first)
    eventually(lambda: len(modem.got) == 5)
    assert modem.got[4].stream == modem.got[1].stream
    assert modem.got[4].image_id not in {image.image_id for image in modem.got[:4]}


def test_wider_where_there_is_nothing_wider_is_said(begin, ask, atd, modem, snippet, with_wide):
    service = begin()
    atd.owe(IN, "compressor", snippet("plain"), with_wide("c1"))
    eventually(lambda: len(modem.got) == 2)
    plain, first = (image.image_id for image in modem.got)
    counters = lambda: service.health().counters  # noqa: E731
    ask("wider", plain)
    eventually(lambda: counters().get("commands_nothing_wider") == 1)
    ask("wider", "ZZZZ")
    eventually(lambda: counters().get("commands_unknown_image") == 1)
    ask("wider", first)
    eventually(lambda: len(modem.got) == 3)
    ask("wider", modem.got[2].image_id)  # around the wider one nothing more is kept
    eventually(lambda: counters().get("commands_nothing_wider") == 2)
    ask("resend", modem.got[2].image_id)
    eventually(lambda: len(modem.got) == 4)
    assert modem.got[3] == modem.got[2]


def test_pixels_too_large_for_a_record_are_not_known(with_wide):
    wide = wider(with_wide("c1", pixel_along_m=60.0, pixel_across_m=None))
    assert (wide.contact.pixel_along_m, wide.contact.pixel_across_m) == (None, None)
    assert wide.wide is None


def test_what_a_version_without_wider_pictures_has_kept_is_still_given(begin, ask, atd, modem, snippet):
    service = begin()
    atd.owe(IN, "compressor", snippet("c1"))
    eventually(lambda: len(modem.got) == 1)
    name = f"kept/{modem.got[0].image_id}"
    image, packed, _ = msgpack.unpackb(service.store.get_state(name))
    with service.store.transaction() as tx:
        tx.put_state(name, msgpack.packb([image, packed]))
    ask("resend", modem.got[0].image_id)
    eventually(lambda: len(modem.got) == 2)
    assert modem.got[1] == modem.got[0]
