"""Retention of the images in the console's database."""

import time

from builders.console import image_record

DAY_S = 86400.0
FIRST, SECOND = (f"sonarpost.vessel-1.uuv-1.20231114T221320Z.{name}" for name in ("00A7", "00A8"))


def sizes(console) -> dict[tuple[str, int], int]:
    """Return the sizes of the stored versions."""
    with console.state.database.read() as db:
        rows = db.execute("SELECT contact_id, version, LENGTH(payload) FROM version WHERE removed = 0")
        return {(str(row[0]), int(row[1])): int(row[2]) for row in rows}


def test_old_images_are_removed_by_default_and_decisions_stay(console):
    console.state.store_image(image_record())
    anna = console.browser("anna")
    assert anna.decide(FIRST).status_code == 201
    assert console.state.remove_images(time.time() + 400 * DAY_S) == 0, "a clock that is ahead makes no image old"
    later_utc_s = time.time() + 366 * DAY_S
    console.state.clock = lambda: later_utc_s
    console.state.store_image(image_record("00A8"))
    console.state.clock = time.time
    assert console.state.remove_images(later_utc_s - 2 * DAY_S) == 0
    assert console.state.remove_images(later_utc_s) == 1
    assert console.state.remove_images(later_utc_s) == 0
    detail = anna.contact(FIRST)
    assert [decision["verdict"] for decision in detail["decisions"]] == ["mine_like"]
    assert len(detail["audit"]) > 0
    assert detail["contact"]["has_image"] is False
    assert detail["record"]["lat_deg"] == 56.0
    assert "image removed by retention" in str(detail["versions"])
    assert not console.state.store_image(image_record())
    with console.state.database.read() as db:
        assert db.execute("SELECT LENGTH(payload) FROM version").fetchone()[0] < 3000


def test_many_vehicles_of_one_vessel_displace_no_image_of_another(make_console):
    console = make_console(max_bytes=0)
    for image_id in ("00A7", "00A8"):
        console.state.store_image(image_record(image_id))
    for number in range(4):
        console.state.store_image(image_record(vessel="vessel-2", vehicle=f"uuv-{number + 2}"))
    total = sum(sizes(console).values())
    console.state.config = console.state.config.model_copy(update={"max_bytes": 2 * total // 3})
    assert console.state.remove_images(time.time()) == 2
    assert {contact for contact, _ in sizes(console)} >= {FIRST, SECOND}


def test_images_with_a_decision_are_removed_last(make_console):
    console = make_console(max_bytes=0)
    for image_id in ("00A7", "00A8"):
        console.state.store_image(image_record(image_id))
        console.state.store_image(image_record(image_id, version=2))
    console.browser("anna").decide(SECOND, version=2)
    order = [(FIRST, 1), (SECOND, 1), (FIRST, 2), (SECOND, 2)]
    for removed in order:
        stored = sizes(console)
        limited = console.state.config.model_copy(update={"max_bytes": sum(stored.values()) - 1})
        console.state.config = limited
        assert console.state.remove_images(time.time()) == 1
        assert set(stored) - set(sizes(console)) == {removed}
