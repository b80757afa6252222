"""Objects of the console: association in the database, one verdict for all looks, changes by a person, flags."""

import json
import random

import pytest
from builders.console import FIRST_UTC_S, image_record

from sonarpost.review.positions import destination
from sonarpost.services.console.store import association

PLACE = (56.0, -5.0)


def place(north_m=0.0, east_m=0.0):
    return destination(*destination(*PLACE, 0.0, north_m), 90.0, east_m)


def store(console, image_id, north_m=0.0, east_m=0.0, *, vehicle="uuv-1", seed=0, **fields):
    """Store an image of a look; returns the contact identifier."""
    record = image_record(image_id, position=place(north_m, east_m), vehicle=vehicle, seed=seed, **fields)
    console.state.store_image(record)
    with console.state.database.read() as db:
        found = db.execute("SELECT id FROM contact WHERE image_id = ? AND vehicle_id = ?", (image_id, vehicle))
        return found.fetchone()[0]


def store_two_looks(console):
    return [
        store(console, "0001", heading_deg=0.0),
        store(console, "0002", 2.0, vehicle="uuv-2", seed=7, heading_deg=90.0),
    ]


def object_of(console, contact_id):
    with console.state.database.read() as db:
        return association.object_of(db, contact_id)


def partition(console):
    """Image identifiers of each object."""
    with console.state.database.read() as db:
        rows = db.execute("SELECT group_id, image_id FROM contact ORDER BY image_id").fetchall()
    found = {}
    for group, image_id in rows:
        found.setdefault(group, []).append(image_id)
    return sorted(found.values())


def decide_object(browser, object_id, **changes):
    """Decide on all looks of an object, as the panel displays them."""
    detail = browser.get(f"/api/objects/{object_id}").json()
    looks = [
        {"contact": one["contact"]["id"], "revision": one["contact"]["revision"], "sha256": one["sha256"]}
        | {"version": one["contact"]["version"]}
        for one in detail["looks"]
    ]
    return browser.post(f"/api/objects/{object_id}/decisions", {"looks": looks, "verdict": "mine_like", **changes})


def test_objects_do_not_depend_on_the_order_of_arrival(make_console):
    draws = random.Random(3)
    looks = [
        (f"{number:02}{one:02}", 25.0 * number + draws.gauss(0, 5), draws.gauss(0, 5), 2000.0 * one)
        for number in range(6)
        for one in range(3)
    ]
    found = []
    for _ in range(3):
        console = make_console()
        for image_id, north_m, east_m, time_s in looks:
            store(console, image_id, north_m, east_m, position_sigma_m=5.0, time_utc_s=FIRST_UTC_S + time_s)
        found.append(partition(console))
        draws.shuffle(looks)
    assert found[0] == found[1] == found[2]
    assert len(found[0]) < len(looks)


def test_identifier_stays_and_a_look_moves_to_a_better_object(console):
    first = store(console, "0001")
    object_id = object_of(console, first)
    middle = store(console, "0002", 6.0, vehicle="uuv-2")
    assert object_of(console, middle) == object_id
    # The third look is nearer to the second than the first is, and too far from both together.
    better = store(console, "0003", 11.0, vehicle="uuv-3")
    assert object_of(console, middle) == object_of(console, better) != object_of(console, first)
    assert object_id in {object_of(console, one) for one in (first, middle)}
    events = console.state.events.events_after(0) or ()
    published = [json.loads(event.data)["contact"] for event in events if event.name == "contact"]
    assert {row["object"] for row in published if row["id"] == middle} == {object_of(console, middle), object_id}


def test_large_areas_stay_limited(console, monkeypatch):
    monkeypatch.setattr(association, "MAX_LOOKS", 5)
    for number in range(12):
        store(console, f"{number:04}", 7.0 * number, vehicle=f"uuv-{number}")
    assert sum(map(len, partition(console))) == 12
    near = store(console, "1000", 0.5, vehicle="uuv-99")
    with console.state.database.read() as db:
        first = db.execute("SELECT id FROM contact WHERE image_id = '0000'").fetchone()[0]
    assert object_of(console, near) == object_of(console, first)


def test_many_contacts_of_a_vehicle_at_one_place_are_compared_in_part(console, monkeypatch):
    """A flood of one vehicle neither makes each image slower, nor hides the looks of another vehicle."""
    monkeypatch.setattr(association, "MAX_LOOKS", 5)
    monkeypatch.setattr(association, "MAX_NEAR", 5)
    steps, compare = [0], association.possible_partners

    def possible_partners(look, others, rule):
        steps[-1] += len(others)
        return compare(look, others, rule)

    monkeypatch.setattr(association, "possible_partners", possible_partners)
    first = store(console, "2000", 3.0, vehicle="uuv-2")
    for number in range(60):
        steps.append(0)
        store(console, f"{number:04}", time_utc_s=FIRST_UTC_S + 100.0 * number)
    assert max(steps[30:]) <= 2 * (association.MAX_LOOKS + 1) * association.MAX_NEAR * 2
    assert max(map(len, partition(console))) <= 4 * association.MAX_LOOKS
    other = store(console, "2001", 3.0, vehicle="uuv-2", time_utc_s=FIRST_UTC_S + 500.0)
    with console.state.database.read() as db:
        [look] = association.looks_of_object(db, object_of(console, other))[:1]
        near = {one.contact_id for one in association.looks_near(db, look, 64.0)}
    assert first in near | {look.contact_id}
    assert sum("uuv-1" in one for one in near) == association.MAX_NEAR


def test_object_of_two_looks(console):
    one, other = store_two_looks(console)
    detail = console.browser("watch").get(f"/api/objects/{object_of(console, one)}").json()
    assert detail["number_of_looks"] == 2
    # Objects on the starboard side see the vehicle at heading - 90°.
    assert [(look["contact"]["id"], look["aspect_deg"]) for look in detail["looks"]] == [(other, 0.0), (one, 270.0)]
    assert detail["vehicles"] == ["uuv-1", "uuv-2"]
    assert detail["lat_deg"] == pytest.approx(place(1.0)[0], abs=1e-7)
    assert detail["position_sigma_m"] is None
    assert not detail["contradictory"]


def test_fused_size_and_position(console):
    one = store(console, "0001", position_sigma_m=2.0, length_m=1.0, width_m=2.0, height_m=0.5)
    store(console, "0002", 2.0, vehicle="uuv-2", position_sigma_m=2.0, length_m=2.4, width_m=1.2, height_m=0.7)
    detail = console.browser("watch").get(f"/api/objects/{object_of(console, one)}").json()
    assert detail["length_m"]["value"] == pytest.approx(2.2)
    assert detail["width_m"]["value"] == pytest.approx(1.1)
    assert detail["height_m"] == {"value": pytest.approx(0.6), "sigma": pytest.approx(0.1), "looks": 2}
    assert detail["position_sigma_m"] == pytest.approx(2.0 / 2**0.5)


def test_one_verdict_for_all_looks_and_one_undo(console):
    one, other = store_two_looks(console)
    anna = console.browser("anna")
    object_id = object_of(console, one)
    answer = decide_object(anna, object_id, confidence=0.7, remark="both")
    assert answer.status_code == 201, answer.text
    assert [d["verdict"] for d in answer.json()["decisions"]] == ["mine_like"] * 2
    for contact_id in (one, other):
        detail = anna.contact(contact_id)
        assert detail["contact"]["review"] == "mine_like"
        [entry] = detail["audit"]
        assert entry["sha256"] == detail["versions"][-1]["sha256"]
    last = anna.get("/api/decisions/last").json()
    undone = anna.post(f"/api/contacts/{last['contact']['id']}/undo", {"decision_id": last["decision"]["decision_id"]})
    assert undone.status_code == 201, undone.text
    assert [anna.contact(one)["contact"]["review"], anna.contact(other)["contact"]["review"]] == ["unreviewed"] * 2
    assert anna.get("/api/decisions/last").json()["decision"] is None


def test_undo_keeps_a_later_decision_on_one_of_the_looks(console):
    one, other = store_two_looks(console)
    anna = console.browser("anna")
    decided = decide_object(anna, object_of(console, one)).json()["decisions"]
    assert anna.decide(other, verdict="unsure").status_code == 201
    first = next(d for d in anna.contact(one)["decisions"])
    assert first["decision_id"] in {d["decision_id"] for d in decided}
    anna.post(f"/api/contacts/{one}/undo", {"decision_id": first["decision_id"]})
    assert anna.contact(one)["contact"]["review"] == "unreviewed"
    assert anna.contact(other)["contact"]["review"] == "unsure"


def test_a_wrong_look_stores_nothing(console):
    one, other = store_two_looks(console)
    anna = console.browser("anna")
    first, second = (
        {"contact": item["contact"]["id"], "revision": 0, "version": 1, "sha256": item["sha256"]}
        for item in anna.get(f"/api/objects/{object_of(console, one)}").json()["looks"]
    )
    wrong = ({"sha256": "0" * 64}, {"contact": "sonarpost.unknown"}, {"version": 9})
    many = [first | {"contact": f"c{number}"} for number in range(50)]
    for looks in (*([first, second | change] for change in wrong), [first, second, first], [], [first, second, *many]):
        assert decide_object(anna, object_of(console, one), looks=looks).status_code == 400
    assert {anna.contact(c)["contact"]["review"] for c in (one, other)} == {"unreviewed"}
    assert anna.contact(one)["audit"] == []


def test_observers_change_no_object(console):
    one, other = store_two_looks(console)
    watch, object_id = console.browser("watch"), object_of(console, one)
    assert watch.get(f"/api/objects/{object_id}").status_code == 200
    assert decide_object(watch, object_id).status_code == 403
    for action in ("split", "merge"):
        assert watch.post(f"/api/objects/{object_id}/{action}", {"contact": other}).status_code == 403
    for object_id in ("g999", "", "x" * 300):
        assert watch.get(f"/api/objects/{object_id}").status_code == 404


def test_split_survives_new_looks(console):
    one, other = store_two_looks(console)
    anna = console.browser("anna")
    object_id = object_of(console, one)
    answer = anna.post(f"/api/objects/{object_id}/split", {"contact": other})
    assert answer.status_code == 200, answer.text
    assert [look["contact"]["id"] for look in answer.json()["looks"]] == [one]
    assert [near["contact"]["id"] for near in answer.json()["nearby"]] == [other]
    store(console, "0003", 1.0, vehicle="uuv-3")
    assert object_of(console, one) != object_of(console, other)
    [entry] = anna.contact(other)["audit"]
    assert (entry["action"], entry["user"], entry["detail"]["object"]) == ("split", "anna", object_id)
    assert anna.post(f"/api/objects/{object_id}/split", {"contact": other}).status_code == 400


def test_merge_survives_new_looks_and_is_reversed_by_split(console):
    # On one pass, looks more than a quarter of the radius apart are two objects.
    one, near = store(console, "0001"), store(console, "0002", 6.0)
    anna = console.browser("anna")
    object_id = object_of(console, one)
    assert object_of(console, near) != object_id
    answer = anna.post(f"/api/objects/{object_id}/merge", {"contact": near})
    assert answer.status_code == 200, answer.text
    assert answer.json()["number_of_looks"] == 2
    store(console, "0003", 7.0, vehicle="uuv-3")
    assert object_of(console, one) == object_of(console, near) == object_id
    assert anna.contact(near)["audit"][0]["action"] == "merge"
    anna.post(f"/api/objects/{object_id}/split", {"contact": one})
    assert object_of(console, one) != object_of(console, near)


def test_objects_within_the_association_gate_can_be_joined(console, monkeypatch):
    one, near = store(console, "0001", position_sigma_m=0.8), store(console, "0002", 6.0, position_sigma_m=0.8)
    far = store(console, "0003", 28.0, position_sigma_m=0.8)
    console.state.store_image(image_record("0004", position=None))
    anna = console.browser("anna")
    path = f"/api/objects/{object_of(console, one)}"
    candidates = anna.get(path).json()["nearby"]
    assert [(each["contact"]["id"], round(each["distance_m"], 1)) for each in candidates] == [(near, 6.0)]
    without_position = anna.rows()["0004"]["id"]
    for contact_id, status in ((far, 400), (one, 400), (without_position, 400), ("unknown", 404)):
        assert anna.post(path + "/merge", {"contact": contact_id}).status_code == status
    # A position of 8 m at one standard deviation agrees with one 24 m away.
    uncertain = store(console, "0005", 52.0, position_sigma_m=8.0)
    found = anna.get(f"/api/objects/{object_of(console, uncertain)}").json()["nearby"]
    assert [each["contact"]["id"] for each in found] == [far]
    monkeypatch.setattr("sonarpost.services.console.store.objects.MAX_OBJECT_LOOKS", 1)
    assert anna.post(path + "/merge", {"contact": near}).status_code == 400


def test_contradictory_verdicts_come_first(console):
    one, other = store_two_looks(console)
    newer = store(console, "0009", 500.0)
    anna = console.browser("anna")
    anna.decide(one, verdict="mine_like")
    to_do = lambda: list(anna.rows(review="to_do", sort="arrived").values())  # noqa: E731
    assert [row["id"] for row in to_do()] == [newer, other]
    anna.decide(other, verdict="not_mine_like")
    rows = to_do()
    assert [(row["id"], row["contradictory"]) for row in rows][2:] == [(newer, False)]
    assert {row["id"] for row in rows[:2] if row["contradictory"]} == {one, other}
    assert console.state.counts().to_do == len(rows)
    assert anna.get(f"/api/objects/{object_of(console, one)}").json()["contradictory"]
    anna.decide(other, verdict="mine_like")
    assert not anna.contact(one)["contact"]["contradictory"]


def test_decided_on_less_than_has_arrived(console):
    contact_id = store(console, "0001", missing_rows=20)
    anna = console.browser("anna")
    anna.decide(contact_id, verdict="not_mine_like")
    row = anna.contact(contact_id)["contact"]
    assert (row["decided_on"], row["newer_detail"]) == ({"version": 1, "bytes": 100}, False)
    assert anna.get("/api/contacts", review="newer_detail").json()["matching"] == 0
    store(console, "0001", version=2)
    [row] = anna.get("/api/contacts", review="newer_detail").json()["items"]
    assert (row["newer_detail"], row["bytes_received"], row["review"]) == (True, 200, "not_mine_like")
    anna.decide(contact_id, verdict="not_mine_like")
    assert anna.get("/api/contacts", review="newer_detail").json()["matching"] == 0


def test_earlier_contacts_of_past_missions(make_console):
    console = make_console(mission_gap_s=3600.0)
    day = 86400.0
    old = store(console, "0001", first_utc_s=FIRST_UTC_S - 2 * day)
    older = store(console, "0002", 3.0, vehicle="uuv-2", first_utc_s=FIRST_UTC_S - 5 * day)
    store(console, "0003", 300.0, first_utc_s=FIRST_UTC_S - 2 * day)
    today = store(console, "0004")
    anna = console.browser("anna")
    anna.decide(older, verdict="not_mine_like")
    detail = anna.contact(today)
    assert [(row["id"], row["review"]) for row in detail["earlier"]] == [(old, "unreviewed"), (older, "not_mine_like")]
    assert detail["contact"]["looks"] == 1
    assert [row["id"] for row in anna.contact(old)["earlier"]] == [older]
