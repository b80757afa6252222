"""docs/specifications/console-api.md names all routes and fields of responses."""

from __future__ import annotations

import re

from builders.common import REPOSITORY
from builders.console import contact_id, image_record, queue_state, received_frame

TEXT = (REPOSITORY / "docs" / "specifications" / "console-api.md").read_text(encoding="utf-8")


def test_all_routes_are_documented(console):
    paths = [route.path for route in console.app.asgi._app.routes]
    assert len(paths) > 20
    for path in paths:
        *_, before, last = re.sub(r"\{(\w+):\w+\}", r"{\1}", path).split("/")
        known = {"/": "`GET /`", "/api/export/{name}": "/api/export/contacts.geojson", "/static": "`/static/`"}
        assert known.get(path, f"/{last}" if before in ("", "{version}") else f"{before}/{last}") in TEXT, path


def test_all_fields_of_information_contacts_and_mission_are_documented(make_console):
    console = make_console(downlink_rate=0)
    console.state.store_image(image_record())
    console.state.fleet.add_frame("uuv-1", received_frame())
    console.state.fleet.set_queue(queue_state([], console.state.clock()))
    anna = console.browser("anna")
    anna.decide(contact_id())
    detail, found = anna.contact(contact_id()), anna.get("/api/mission").json()
    [vehicle] = found["vehicles"]
    parts = [anna.get("/api/info").json(), detail, detail["contact"], found, vehicle, found["operators"][0]]
    parts += [detail[name][0] for name in ("versions", "decisions", "audit")]
    parts += [vehicle[name] for name in ("uplink", "queue", "downlink")]
    assert {name for part in parts for name in part if f'"{name}"' not in TEXT} == set()
