"""Queries of the contacts: the indexes that keep them fast with 50,000 contacts."""

from collections.abc import Callable
from typing import Any

import pytest
from builders.console import image_record

from sonarpost.services.console.store import contacts
from sonarpost.services.console.store.association import find_look, looks_near
from sonarpost.services.console.store.contacts import ContactFilter


def plans(console: Any, query: Callable[[Any], object]) -> str:
    """Return the query plans of all statements of a query."""
    statements: list[str] = []
    with console.state.database.read() as db:
        db.set_trace_callback(statements.append)
        query(db)
        db.set_trace_callback(None)
        return "\n".join(row["detail"] for sql in statements for row in db.execute(f"EXPLAIN QUERY PLAN {sql}"))


@pytest.mark.parametrize(
    ("query", "index"),
    [
        ({}, "contact_updated"),
        ({"review": "unreviewed"}, "contact_updated"),
        ({"review": "to_do", "sort": "arrived"}, "contact_contradictory"),
        ({"review": "to_do", "sort": "arrived", "order": "asc"}, "contact_first"),
    ],
)
def test_page_of_contacts_is_read_in_the_order_of_an_index(console, query, index):
    console.state.store_image(image_record())
    plan = plans(console, lambda db: contacts.list_contacts(db, ContactFilter(**query)))
    assert f"SCAN c USING INDEX {index}" in plan
    # The contacts are counted without reading them.
    assert plan.count("USING COVERING INDEX contact_listed") == 3
    assert "contact_answers" not in plan
    assert "USING INDEX decision_undelivered" in plan
    assert "USING INDEX contact_authenticated" in plan


def test_looks_at_a_place_are_found_by_latitude_and_longitude(console):
    console.state.store_image(image_record())
    [item] = console.state.list_contacts(ContactFilter())["items"]

    def search(db: Any) -> None:
        look = find_look(db, item["id"])
        assert look is not None
        looks_near(db, look, 100.0)

    assert "USING INDEX contact_square (<expr>=? AND lon_deg>? AND lon_deg<?)" in plans(console, search)


def test_looks_near_cross_the_180th_meridian(console):
    for image_id, position in (
        ("0001", (-17.0, 179.9999)),
        ("0002", (-17.0, -179.9999)),
        ("0003", (-17.0004, -179.9999)),
        ("0004", (-17.0, 179.99)),
        ("0005", (17.0, 179.9999)),
    ):
        console.state.store_image(image_record(image_id, position=position))
    with console.state.database.read() as db:
        look = find_look(db, db.execute("SELECT id FROM contact WHERE image_id = '0001'").fetchone()[0])
        assert look is not None
        found = sorted(near.contact_id[-4:] for near in looks_near(db, look, 60.0))
    assert found == ["0002", "0003"]
