"""Queries to c2: filters, pages, limits, JSON, and a subscriber that catches up."""

import base64
import io
import json
import shutil
import threading

import msgpack
import numpy as np
import pytest
import zenoh
from builders.common import WAIT_S, eventually
from builders.postgresql import execute
from builders.records import decision_record, reconstructed_image
from builders.shore import CONTACTS, number_images, relayed
from PIL import Image

from sonarpost import keys, wire
from sonarpost.archive.journal import Journal
from sonarpost.bus.catch_up import CatchUpSubscriber
from sonarpost.messages import Comment, Contact, Decision, Pixels, ReconstructedImage
from sonarpost.services.c2 import queries
from sonarpost.services.c2.archive import Archive


def image(image_id="0001", *, version=1, vehicle="uuv-1", vessel="vessel-1", lat=56.4, lon=-5.6, size=4, **changes):
    pixels = np.arange(size * size, dtype=np.uint32).reshape(size, size).astype(np.uint8)
    contact = Contact(contact_id=f"{vehicle}/{image_id}", vehicle_id=vehicle, lat_deg=lat, lon_deg=lon)
    return reconstructed_image(
        Pixels.from_array(pixels),
        image_id=image_id,
        version=version,
        vehicle_id=vehicle,
        vessel_id=vessel,
        contact=contact,
        **changes,
    )


def partial_image(image_id="0001", **changes):
    """An image with missing pixels, which are black, and a received black pixel outside of their rows."""
    pixels = np.full((6, 5), 9, np.uint8)
    pixels[0, 0] = 0
    missing = np.zeros((6, 5), np.bool_)
    missing[3:5, 1:] = True
    pixels[missing] = 0
    return reconstructed_image(
        Pixels.from_array(pixels),
        image_id=image_id,
        complete=False,
        missing_fraction=8 / 30,
        missing_mask=np.packbits(missing).tobytes(),
        **changes,
    )


class Shore:
    """A c2 whose records arrive without a relay."""

    def __init__(self, service, client):
        self.service = service
        self.client = client
        self._querier = client.declare_querier(CONTACTS)
        eventually(lambda: self._querier.matching_status.matching, what="queryable")

    def handled(self):
        return int(self.service.health().counters.get("records_handled", 0))

    def put(self, key, record):
        self.client.put(key, wire.encode(record), congestion_control=zenoh.CongestionControl.BLOCK)

    def accept(self, *records):
        before = self.handled()
        for record in records:
            self.put(keys.shore_inbox(record.vessel_id), relayed(record))
        eventually(lambda: self.handled() == before + len(records), what="acceptance")

    def replies(self, selector):
        """Return the replies of one page and the page."""
        found = []

        def is_answered():
            # A router drops replies of c2 that wait for 50 ms, and it may not know the queryable yet.
            found[:] = self.client.get(selector, consolidation=zenoh.ConsolidationMode.NONE, timeout=WAIT_S)
            return bool(found)

        eventually(is_answered, what=f"replies to {selector}")
        errors = [reply.err.payload.to_string() for reply in found if reply.err is not None]
        assert errors == []
        samples = [reply.ok for reply in found]
        return samples[:-1], samples[-1]

    def pages(self, parameters=""):
        """Return the replies of each page of the contacts, the last cursor included."""
        found, cursor, more = [], "", True
        while more:
            samples, page = self.replies(f"{CONTACTS}?{parameters}after={cursor}")
            fields = msgpack.unpackb(page.payload.to_bytes())
            assert fields["records"] == len(samples)
            found.append([msgpack.unpackb(s.payload.to_bytes())["image_id"] for s in samples])
            cursor, more = fields["next"], fields["more"]
        return found, cursor

    def names(self, selector):
        samples, _ = self.replies(selector)
        records = [msgpack.unpackb(sample.payload.to_bytes()) for sample in samples]
        return [
            f"{r['image_id']}.{r['version']}" if r["type"] == "reconstructed_image" else r.get("decision_id", r["type"])
            for r in records
        ]

    def error(self, selector):
        [reply] = list(self.client.get(selector, timeout=WAIT_S))
        assert reply.err is not None
        assert reply.err.encoding == zenoh.Encoding.TEXT_PLAIN
        return str(reply.err.payload.to_string())


@pytest.fixture
def begin(begin, client, fast_queries):
    return lambda **options: Shore(begin(**options), client)


@pytest.fixture
def shore(begin):
    return begin()


def test_replies_equal_the_publications_and_the_page_is_last(shore, watch):
    seen = watch(CONTACTS)
    shore.accept(image(), partial_image("0002"), decision_record("d1", image_id="0001"))
    eventually(lambda: len(seen) == 3)
    samples, page = shore.replies(CONTACTS)
    assert [(str(s.key_expr), str(s.encoding), s.payload.to_bytes()) for s in samples] == [
        (str(s.key_expr), str(s.encoding), s.payload.to_bytes()) for s in seen
    ]
    assert [s.attachment for s in (*samples, *seen)] == [None] * 6
    accepted = [msgpack.unpackb(s.payload.to_bytes())["accepted"] for s in samples]
    assert [a["seq"] for a in accepted] == [1, 2, 3]
    assert str(page.encoding) == "application/msgpack;schema=sonarpost.page.v1"
    fields = msgpack.unpackb(page.payload.to_bytes())
    archive = accepted[0]["archive"]
    assert fields == {"type": "page", "v": 1, "records": 3, "unreadable": 0, "more": False, "next": f"{archive}.3"}
    assert str(page.key_expr) == CONTACTS


def test_filters(shore):
    shore.accept(
        image("0001"),
        image("0001", version=2),
        image("0002", vehicle="uuv-2", lat=57.0, lon=179.5),
        image("0003", vessel="vessel-2", lat=-10.0, lon=-179.5),
        decision_record("d1", image_id="0001"),
        decision_record("d2", image_id="0001", operator="other", verdict="unsure"),
        decision_record("d3", image_id="0002", vehicle_id="uuv-2", verdict="not_mine_like"),
    )
    all_names = ["0001.1", "0001.2", "0002.1", "0003.1", "d1", "d2", "d3"]
    for parameters, expected in (
        ("", all_names),
        ("version=all", all_names),
        ("version=latest", ["0001.2", "0002.1", "0003.1", "d1", "d2", "d3"]),
        ("vehicle=uuv-2", ["0002.1", "d3"]),
        ("vessel=vessel-2", ["0003.1"]),
        ("vessel=vessel-9", []),
        ("area=56,-6,57,-5", ["0001.1", "0001.2", "d1", "d2"]),
        ("area=-20,179,80,-179", ["0002.1", "0003.1", "d3"]),
        ("review=disputed", ["0001.1", "0001.2", "d1", "d2"]),
        ("review=not_mine_like", ["0002.1", "d3"]),
        ("review=unreviewed", ["0003.1"]),
        ("_time=[now(-1h)..]", all_names),
        ("_time=[..now(-1h)[", []),
        ("_time=[2020-01-01T00:00:00Z..now(1h)[;limit=1", ["0001.1"]),
        ("_anyke", all_names),
        ("version=latest;vehicle=uuv-1;review=disputed;limit=2", ["0001.2", "d1"]),
    ):
        assert shore.names(f"{CONTACTS}?{parameters}") == expected, parameters
    assert shore.names("sonarpost/v1/shore/contact/vessel-1/image") == ["0001.1", "0001.2", "0002.1"]
    assert shore.names("sonarpost/v1/shore/contact/*/decision") == ["d1", "d2", "d3"]


def test_time_range_is_half_open(shore):
    shore.accept(image("0001"))
    [sample], _ = shore.replies(CONTACTS)
    at = msgpack.unpackb(sample.payload.to_bytes())["accepted"]["utc_s"]
    execute(shore.service._archive.index(), "UPDATE record SET accepted_utc_s = 1700000000.0")
    assert at > 1700000000
    begin, later = "2023-11-14T22:13:20Z", "2023-11-14T22:13:21%2B00:00"
    assert shore.names(f"{CONTACTS}?_time=[{begin}..{later}[") == ["0001.1"]
    assert shore.names(f"{CONTACTS}?_time=[..{begin}[") == []
    assert shore.names(f"{CONTACTS}?_time=[..{begin}]") == ["0001.1"]
    assert shore.names(f"{CONTACTS}?_time=]{begin}..]") == []


def test_pages_hold_every_record_once(shore):
    shore.accept(*(image(f"{n:04X}") for n in range(1, 26)))
    pages, cursor = shore.pages("limit=10;")
    assert [len(page) for page in pages] == [10, 10, 5]
    assert [name for page in pages for name in page] == [f"{n:04X}" for n in range(1, 26)]
    assert shore.names(f"{CONTACTS}?after={cursor}") == []
    shore.accept(image("00AA"))
    assert shore.names(f"{CONTACTS}?after={cursor}") == ["00AA.1"]


def test_page_is_limited_in_bytes_but_has_at_least_one_record(shore, monkeypatch):
    monkeypatch.setattr(queries, "MAX_BYTES", 30_000)
    shore.accept(image("0001", size=250), image("0002", size=100), image("0003", size=100), image("0004", size=100))
    assert shore.pages()[0] == [["0001"], ["0002", "0003"], ["0004"]]


INVALID = [
    ("limit=0", "limit", "1 to 256"),
    ("limit=257", "limit", "1 to 256"),
    ("limit=1;limit=2", "limit", "one value"),
    ("vehicle=UUV", "vehicle", "1 to 32 of a-z"),
    ("vessel=", "vessel", "1 to 32 of a-z"),
    ("area=1,2,3", "area", "SOUTH,WEST,NORTH,EAST"),
    ("area=1,2,0,4", "area", "SOUTH,WEST,NORTH,EAST"),
    ("area=nan,0,1,1", "area", "SOUTH,WEST,NORTH,EAST"),
    ("area=0,0,91,1", "area", "SOUTH,WEST,NORTH,EAST"),
    ("review=maybe", "review", "unreviewed or mine_like"),
    ("version=2", "version", "latest or all"),
    ("after=5", "after", "the `next` of an earlier page"),
    ("after=00000000.5", "after", "a cursor of "),
    ("format=xml", "format", "msgpack or json"),
    ("pixels=png", "pixels", "raw, unless format is json"),
    ("_time=yesterday", "_time", "[START..END["),
    ("_time=[2023-11-14T22:13:20..]", "_time", "[START..END["),
    ("_time=[now(99999999999999w)..]", "_time", "[START..END["),
    ("vehical=uuv-1", "vehical", "one of the parameters _time, vessel"),
    ("' OR 1=1 --", "' OR 1", "one of the parameters"),
    ("vehicle=" + "a" * 1000, "parameters", "at most 1000 characters"),
]


def test_invalid_query_gets_one_error(shore):
    selectors = [(f"{CONTACTS}?{parameters}", field, expected) for parameters, field, expected in INVALID]
    outside = "sonarpost/v1/shore/contact/**"
    selectors.append((outside, "key", "a key expression within sonarpost/v1/shore/contact/*/*"))
    for selector, field, expected in selectors:
        text = shore.error(selector)
        assert text.startswith(f"{selector.partition('?')[0]}: {field}: got ")
        assert f", expected {expected}" in text


def test_tasking_states_are_all_in_order_or_the_latest(shore, runner):
    fields = {"vehicle_id": "uuv-1", "image_id": "0001", "image_version": 1, "author": "expert", "commented_utc_s": 2.0}
    comment = Comment(comment_id="a-1", vessel_id="vessel-1", **fields, verdict="unsure")
    shore.put(keys.tasking_comment("vessel-1"), comment)
    selector = keys.tasking_state_all()
    eventually(lambda: shore.names(selector) == ["tasking_state"])
    runner.peer("vessel-1", "relay", {keys.comment("vessel-1"): Comment})
    eventually(lambda: len(shore.names(selector)) == 2)

    def states(parameters):
        samples, _ = shore.replies(f"{selector}?{parameters}")
        return [msgpack.unpackb(s.payload.to_bytes())["state"] for s in samples]

    assert states("vehicle=uuv-1") == ["waiting", "delivered"]
    assert states("version=latest") == ["delivered"]
    assert states("vehicle=uuv-2") == []


def test_numbers_survive_a_restart_and_repeated_records_keep_theirs(begin, runner):
    shore = begin()
    shore.accept(image("0001"), decision_record("d1"))
    first, page = shore.replies(CONTACTS)
    runner.stop(shore.service)
    shore = begin()
    shore.accept(decision_record("d1"), image("0001"), image("0002"))
    second, _ = shore.replies(CONTACTS)
    assert [s.payload.to_bytes() for s in second[:2]] == [s.payload.to_bytes() for s in first]
    cursor = msgpack.unpackb(page.payload.to_bytes())["next"]
    assert shore.names(f"{CONTACTS}?after={cursor}") == ["0002.1"]


def records(shore):
    """Return the records of a query."""
    types = {"reconstructed_image": ReconstructedImage, "decision": Decision}
    payloads = [sample.payload.to_bytes() for sample in shore.replies(CONTACTS)[0]]
    return [wire.decode(types[msgpack.unpackb(payload)["type"]], payload, "k") for payload in payloads]


def test_records_of_a_lost_archive_are_numbered_from_their_files(begin, runner, out):
    shore = begin()
    sent = [image("0001"), partial_image("0002"), decision_record("d1")]
    shore.accept(*sent)
    before = records(shore)
    [old] = shore.replies(f"{CONTACTS}?limit=1")[0]
    runner.stop(shore.service)
    for path in out.glob("archive.db*"):
        path.unlink()
    shore = begin()
    _, page = shore.replies(CONTACTS)
    assert records(shore) == before == sent
    archive = msgpack.unpackb(old.payload.to_bytes())["accepted"]["archive"]
    assert msgpack.unpackb(page.payload.to_bytes())["next"] != f"{archive}.3"
    assert "the archive was replaced" in shore.error(f"{CONTACTS}?after={archive}.3")


def test_missing_pixels_are_those_that_arrived_after_the_archive_is_restored(begin, runner, out):
    shore = begin()
    partial = partial_image("0001")
    pixels = partial.pixels.to_array()
    pixels[3, 0] = 0  # received, black, in a row with missing pixels
    packed = Pixels.from_array(pixels)
    sent = partial.model_copy(update={"pixels": packed, "pixels_sha256": packed.sha256})
    shore.accept(sent)
    runner.stop(shore.service)
    for path in out.glob("archive.db*"):
        path.unlink()
    shore = begin()
    [reply] = shore.replies(f"{CONTACTS}?limit=1")[0]
    assert wire.decode(ReconstructedImage, reply.payload.to_bytes(), "reply") == sent


def test_removed_image_is_no_longer_sent(begin):
    shore = begin(max_bytes=1)
    shore.accept(image("0001"), decision_record("d1"))
    eventually(lambda: shore.names(CONTACTS) == ["d1"], what="retention")


def test_damaged_image_is_omitted_and_counted(shore, out):
    shore.accept(image("0001"), image("0002"))
    shore.accept(image("0003"))  # from now on, the pixels of the others are in their files only
    first, second, _ = sorted((out / "vessel-1").glob("*.tiff"))
    shutil.copy(second, first)
    pixels = np.zeros((4, 4), np.uint8)
    Image.fromarray(pixels).save(first)
    second.unlink()
    samples, page = shore.replies(CONTACTS)
    assert [msgpack.unpackb(s.payload.to_bytes())["image_id"] for s in samples] == ["0003"]
    fields = msgpack.unpackb(page.payload.to_bytes())
    assert (fields["records"], fields["unreadable"], fields["more"]) == (1, 2, False)


def json_replies(shore, parameters):
    samples, page = shore.replies(f"{CONTACTS}?format=json;{parameters}")
    assert {str(s.encoding) for s in (*samples, page)} == {"application/json"}
    return [json.loads(s.payload.to_bytes()) for s in samples], json.loads(page.payload.to_bytes())


def test_json_has_the_same_fields_and_bytes_as_base64(shore):
    sent = partial_image("0001")
    shore.accept(sent, decision_record("d1", remark="Stein \u2014 prüfen"))
    [shown, decision], page = json_replies(shore, "")
    assert page["records"] == 2
    assert (decision["remark"], decision["accepted"]["seq"]) == ("Stein \u2014 prüfen", 2)
    named = shown.pop("accepted")
    assert named["seq"] == 1
    assert f"{named['archive']}.2" == page["next"]
    shown["pixels"]["data"] = base64.b64decode(shown["pixels"]["data"])
    shown["missing_mask"] = base64.b64decode(shown["missing_mask"])
    assert shown == msgpack.unpackb(wire.encode(sent))


def test_json_images(shore):
    pixels = np.array([[0, 256, 65535]], np.uint16)
    packed = Pixels.from_array(pixels)
    shore.accept(reconstructed_image(packed, pixels_sha256=packed.sha256))
    [shown], _ = json_replies(shore, "pixels=png")
    assert sorted(shown["pixels"]) == ["bits", "height_px", "png", "width_px"]
    read = np.asarray(Image.open(io.BytesIO(base64.b64decode(shown["pixels"]["png"]))))
    np.testing.assert_array_equal(read, pixels)
    [shown], _ = json_replies(shore, "pixels=none")
    assert shown["pixels"] == {"bits": 16, "height_px": 1, "width_px": 3}


def test_json_mirror(begin, watch):
    seen = watch("sonarpost/v1/shore/json/**")
    plain = watch(CONTACTS)
    shore = begin(json_mirror=True)
    shore.accept(image("0001"), decision_record("d1"))
    eventually(lambda: len(seen) == 2)
    assert [str(s.key_expr) for s in seen] == [
        "sonarpost/v1/shore/json/contact/vessel-1/image",
        "sonarpost/v1/shore/json/contact/vessel-1/decision",
    ]
    assert {str(s.encoding) for s in seen} == {"application/json"}
    assert [json.loads(s.payload.to_bytes())["accepted"]["seq"] for s in seen] == [1, 2]
    assert len(plain) == 2


# Limits


def test_queries_above_the_limits_are_refused_and_records_are_accepted(shore, monkeypatch):
    """All threads of queries are occupied: further queries are refused, the records of vessels are not delayed."""
    shore.accept(image("0001"))
    blocked, released = threading.Semaphore(0), threading.Event()
    fields = Archive.fields

    def wait(self, row):
        blocked.release()
        released.wait(WAIT_S)
        return fields(self, row)

    monkeypatch.setattr(Archive, "fields", wait)
    try:
        waiting = [shore.client.get(CONTACTS, timeout=WAIT_S) for _ in range(queries.MAX_IN_PROGRESS)]
        for _ in range(queries.THREADS):
            assert blocked.acquire(timeout=WAIT_S)
        eventually(lambda: shore.service._queries._in_progress == queries.MAX_IN_PROGRESS)
        assert shore.error(CONTACTS) == (
            f"{CONTACTS}: busy: got '8 queries in progress', expected at most 8; repeat the query after a second"
        )
        shore.accept(image("0002"), decision_record("d1"))
        assert shore.service.health().state == "ok"
    finally:
        released.set()
    for replies in waiting:
        assert all(reply.ok is not None for reply in replies)
    eventually(lambda: shore.service._queries._in_progress == 0)
    counters = shore.service.health().counters
    assert (counters["queries_answered"], counters["queries_refused"]) == (8, 1)


def test_rate_of_queries_is_limited():
    limit = queries.RateLimit()
    at_s = limit._at_s
    assert [limit.take(at_s) for _ in range(41)] == [True] * 40 + [False]
    assert sum(limit.take(at_s + 0.27) for _ in range(10)) == 5
    assert limit.take(at_s + 1000.0)
    assert sum(limit.take(at_s + 1000.0) for _ in range(100)) == 39


def test_refused_rate_is_an_error_reply(shore, monkeypatch):
    monkeypatch.setattr(queries.RateLimit, "take", lambda self, now_s: False)
    assert ": busy: got 'more', expected at most 20 queries a second" in shore.error(CONTACTS)


# Catch up


def test_subscriber_that_was_away_for_300_contacts_has_each_once(shore, reading):
    """Contacts arrive before, during and after the queries; some publications are repeated."""
    first = [image(f"{n:04X}") for n in range(1, 301)]
    number_images(shore.service, first)
    reader = reading()
    eventually(lambda: len(reader.records) >= 100, what="first records")
    shore.accept(*(image(f"{n:04X}") for n in range(301, 321)), *first[:3])
    reader.wait_for(320)
    shore.accept(image("FFFF"), first[0])
    got = reader.wait_for(321)
    assert sorted(got) == sorted([f"{n:04X}" for n in range(1, 321)] + ["FFFF"])
    assert len({r.seq for r in reader.records}) == 321
    assert {r.archive for r in reader.records} == {shore.service._archive.index().journal.position()[0]}
    # A later subscription continues at the cursor: again nothing twice.
    reader.close()
    shore.accept(image("FFFE"))
    again = reading(reader.subscriber.cursor)
    assert again.wait_for(1)[-1] == "FFFE"
    cursor_seq = int(reader.subscriber.cursor.split(".")[1])
    assert [r.seq for r in again.records] == list(range(cursor_seq + 1, 323))


def test_lost_publications_are_fetched_by_the_next_query(shore, reading):
    reader = reading(refresh_s=0.2)
    eventually(lambda: reader.subscriber.is_caught_up)
    number_images(shore.service, [image("0001"), image("0002")])  # not published
    eventually(lambda: len(reader.records) == 2)


def test_overflow_of_the_buffer_leads_to_a_query(shore, client, monkeypatch):
    monkeypatch.setattr("sonarpost.bus.catch_up.MAX_BUFFERED", 2)
    with CatchUpSubscriber(client, CONTACTS, refresh_s=3600.0) as subscriber:
        eventually(
            lambda: shore.service.session.declare_publisher(keys.shore_image("vessel-1")).matching_status.matching
        )
        shore.accept(*(image(f"{n:04X}") for n in range(1, 11)))
        eventually(lambda: subscriber._overflowed)
        records = iter(subscriber)
        assert sorted(next(records).seq for _ in range(10)) == list(range(1, 11))


def test_subscriber_waits_for_c2_and_begins_anew_after_a_refused_cursor(begin, reading, monkeypatch, caplog):
    monkeypatch.setattr("sonarpost.bus.catch_up.RETRY_S", 0.05)
    reader, other = reading(), reading("00000000.7")
    begin().accept(image("0001"))
    assert reader.wait_for(1) == other.wait_for(1) == ["0001"]
    assert "Archive of c2 was replaced" in caplog.text


def test_journal_that_cannot_be_written_degrades_c2_until_it_can(shore, monkeypatch):
    def full(self, sql, records):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Journal, "number", full)
        shore.put(keys.shore_inbox("vessel-1"), relayed(image("0001")))
        eventually(lambda: shore.service.health().state == "degraded")
    eventually(lambda: shore.names(CONTACTS) == ["0001.1"])
