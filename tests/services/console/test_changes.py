"""Every transaction that changes what is shown of a contact publishes exactly one event about it."""

import inspect
import json
import time
from dataclasses import asdict

import pytest
from builders.console import FIRST_UTC_S, Clock, comment_record, contact_ids, downlink_state, image_record

from sonarpost.errors import DeliveryError
from sonarpost.messages import Decision, TaskingState
from sonarpost.review.measurement import Line
from sonarpost.services.console.state import MAX_CONTACT_EVENTS, ConsoleState
from sonarpost.services.console.store.database import Actor, DisplayedImage
from sonarpost.services.console.store.decisions import DecisionInput
from sonarpost.services.console.store.truth import Truth

ANNA = Actor("anna", "operator", "127.0.0.1")
BO = Actor("bo", "operator", "127.0.0.1")
OF_OTHERS = ("group", "earlier", "costs")
"""Parts of the detail of a contact that are rows of other contacts, or estimates."""


class Recorder:
    """Calls methods of the state, and compares the events of each call with the contacts that it has changed."""

    def __init__(self, console):
        self.state = console.state
        self.called: set[str] = set()

    def snapshot(self):
        with self.state.database.read() as db:
            ids = [row[0] for row in db.execute("SELECT id FROM contact WHERE parent IS NULL")]
        details = {one: self.state.contact_detail(one) for one in ids}
        return {
            one: json.dumps({name: part for name, part in detail.items() if name not in OF_OTHERS}, sort_keys=True)
            for one, detail in details.items()
        }

    def __call__(self, name, *words, **options):
        self.called.add(name)
        before, last = self.snapshot(), self.state.events.last
        result = getattr(self.state, name)(*words, **options)
        after = self.snapshot()
        changed = {one for one, shown in after.items() if before.get(one) != shown}
        events = [json.loads(event.data) for event in self.state.events.events_after(last) if event.name == "contact"]
        assert [event["contact"]["id"] for event in events] == sorted(changed), name
        counts = asdict(self.state.counts())
        for event in events:
            contact = event.pop("contact")
            assert contact == self.state.contact_detail(contact["id"])["contact"]
            assert event == {"new": contact["id"] not in before, **counts}
        self.changed = changed
        return result


@pytest.fixture
def call(console):
    return Recorder(console)


def test_each_change_is_one_event(console, call):
    clock, state = Clock(console), console.state
    call("store_image", image_record("0001"))
    call("store_image", image_record("0002", vehicle="uuv-2", position=(56.0, -5.0)))
    assert len(call.changed) == 2, "both are looks at one object"
    call("store_images", [image_record("0003", position=(56.1, -5.0)), image_record("0004", position=(56.2, -5.0))])
    ids = contact_ids(state)
    one, other, third, fourth = (ids[f"000{number}"] for number in (1, 2, 3, 4))
    call("store_image", image_record("0003", version=2, position=(56.1, -5.0)))
    call("store_image", image_record("0003", version=2, position=(56.1, -5.0)))
    assert call.changed == set()

    def entered(contact_id, verdict="mine_like"):
        version = state.contact_detail(contact_id)["versions"][-1]
        displayed = DisplayedImage(version["version"], version["sha256"], "raw")
        return DecisionInput(0, displayed, verdict, None, None, "")

    def decide(contact_id, verdict="mine_like", actor=ANNA):
        return call("decide", contact_id, entered(contact_id, verdict), actor)["decision"]["decision_id"]

    def send():
        clock.advance(9.0)
        items = call("unsent_records")
        assert items
        for item in items:
            call("mark_sent", item)
            assert call.changed == set()

    # Decision: take-back time, delivery to shore site and vehicle.
    first = decide(third)
    assert call.changed == {third}
    send()
    assert call.changed == set()
    for consumer in ("relay", "op_modem"):
        call("apply_acknowledgement", "decision", first, consumer, None)
        assert call.changed == {third}
    call("mark_delivered_to_shore", clock.now_utc_s + 1.0)
    assert call.changed == {third}
    assert state.counts().undelivered == 1
    for step in ("sent", "confirmed"):
        call("apply_downlink_state", downlink_state("decision", first, step, clock.now_utc_s))
        assert call.changed == {third}
    assert (state.counts().undelivered, state.counts().refused) == (0, 0)
    second = decide(fourth)
    call("apply_acknowledgement", "decision", second, "relay", "no")
    call("apply_downlink_state", downlink_state("decision", second, "expired", clock.now_utc_s))
    assert (state.counts().undelivered, state.counts().refused) == (1, 1)
    listed = console.browser("anna").rows(review="undelivered")
    assert [row["delivery"]["vehicle"] for row in listed.values()] == ["expired"]
    # Another verdict: a dispute, its notice, and its end. Delivery is that of the verdict that counts.
    call("decide", third, entered(third, "not_mine_like"), BO)
    assert console.browser("anna").contact(third)["contact"]["delivery"]["vehicle"] == "confirmed"
    [notice] = state.notices("anna")
    call("acknowledge_notice", notice["id"], ANNA)
    call("undo", third, first, DisplayedImage(), ANNA)
    send()
    # Records of other programs.
    names = {"vessel_id": "vessel-1", "vehicle_id": "uuv-1", "image_id": "0001", "image_version": 1}
    times = {"decided_utc_s": FIRST_UTC_S + 50}
    call("store_decision", Decision(decision_id="d-1", verdict="mine_like", operator="x", **names, **times))
    call("store_comment", comment_record("0001"))
    # A look whose object has contradictory verdicts is changed too.
    decide(other, "not_mine_like")
    assert call.changed == {one, other}
    # Objects.
    [object_id] = {state.contact_detail(contact_id)["contact"]["object"] for contact_id in (one, other)}
    both = {contact_id: entered(contact_id) for contact_id in (one, other)}
    made = call("decide_object", object_id, both, ANNA)["decisions"]
    assert call.changed == {one, other}
    call("undo", one, made[0]["decision_id"], DisplayedImage(), ANNA)
    assert call.changed == {one, other}
    call("split_look", object_id, other, ANNA)
    assert call.changed == {one, other}
    call("merge_objects", object_id, other, ANNA)
    assert call.changed == {one, other}
    # Requests and comments.
    wanted = call("add_request", fourth, "refine", 3.0, ANNA)["command_id"]
    call("apply_acknowledgement", "request", wanted, "op_modem", None)
    call("apply_downlink_state", downlink_state("refine", wanted, "sent", clock.now_utc_s))
    reached = {"vessel_id": "vessel-1", "changed_utc_s": clock.now_utc_s}
    call("apply_tasking_state", TaskingState(kind="command", record_id=wanted, state="delivered", **reached))
    call("store_image", image_record("0004", version=2, total=400, position=(56.2, -5.0)))
    comment = comment_record("0004", comment_id="a-2")
    call("add_comment", fourth, comment, Actor("eva", "expert", "127.0.0.1"))
    call("apply_tasking_state", TaskingState(kind="comment", record_id="a-2", state="delivered", **reached))
    call("add_comment", fourth, comment_record("0004", comment_id="a-3"), Actor("eva", "expert", "127.0.0.1"))
    call("apply_acknowledgement", "comment", "a-3", "c2", "no")
    # Measurements.
    line = Line(2, "raw", "length", (2.0, 2.0), (10.0, 10.0))
    measured = call("measure", fourth, line, ANNA, keep=True)["id"]
    call("withdraw_measurement", fourth, measured, ANNA)
    # Retention.
    console.state.config = console.state.config.model_copy(update={"max_bytes": 0})
    assert call("remove_images", time.time()) > 0
    assert call.changed == {one, other, third, fourth}


def test_revealed_object_is_an_event(console, call):
    clock = Clock(console)
    call("store_image", image_record(), Truth(is_mine_like=True, label="cylinder", sealed=False))
    [contact_id] = contact_ids(console.state).values()
    assert console.browser("anna").decide(contact_id).json()["contact"]["known"] is None
    clock.advance(9.0)
    call("reveal")
    known = console.browser("anna").contact(contact_id)["contact"]["known"]
    assert (call.changed, known) == ({contact_id}, {"label": "cylinder", "is_mine_like": True})


def test_many_changes_of_one_transaction_reload_the_page(console):
    places = [(56.0 + 0.01 * number, -5.0) for number in range(MAX_CONTACT_EVENTS + 1)]
    console.state.store_images([image_record(f"{n:04}", position=place) for n, place in enumerate(places)])
    assert [event.name for event in console.state.events.events_after(0)] == ["reset"]


def test_failed_transaction_is_no_event(console):
    console.state.store_image(image_record())
    last = console.state.events.last
    with pytest.raises(DeliveryError), console.state.database.transaction() as db:
        db.execute("UPDATE contact SET review = 'unsure', version = NULL")
    console.state.mark_delivered_to_shore(0.0)
    assert console.state.events.last == last


def test_all_methods_with_transactions_are_called_above():
    methods = dict(inspect.getmembers(ConsoleState, inspect.isfunction))
    changing = {name for name, method in methods.items() if ".transaction()" in inspect.getsource(method)}
    tests = (test_each_change_is_one_event, test_revealed_object_is_an_event)
    called = "".join(inspect.getsource(test) for test in tests)
    assert {name for name in changing if f'"{name}"' not in called} == {"store_status"}, "shown by the fleet event"
