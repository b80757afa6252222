"""docs/specifications/console-api.md names all routes and fields of responses."""

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


def test_all_fields_of_information_contacts_fleet_and_score_are_documented(make_console):
    console = make_console(downlink_rate=0)
    console.state.store_image(image_record())
    console.state.fleet.add_frame("uuv-1", received_frame())
    console.state.fleet.set_queue(queue_state([], console.state.clock()))
    anna = console.browser("anna")
    anna.decide(contact_id())
    detail, fleet, score = anna.contact(contact_id()), anna.get("/api/fleet").json(), anna.get("/api/score").json()
    [vehicle] = fleet["vehicles"]
    parts = [anna.get("/api/info").json(), detail, detail["contact"], fleet, vehicle, score, score["watch"][0]]
    parts += [detail[name][0] for name in ("versions", "decisions", "audit")]
    parts += [vehicle["queue"], anna.get("/api/map").json(), anna.get("/api/map/tracks").json()]
    assert {name for part in parts for name in part if f'"{name}"' not in TEXT} == set()


def test_types_of_the_scripts_have_the_fields_of_the_server(make_console):
    text = (REPOSITORY / "services" / "console" / "page_types.d.ts").read_text(encoding="utf-8")
    console = make_console(downlink_rate=0)
    console.state.store_image(image_record())
    anna = console.browser("anna")
    anna.decide(contact_id())
    assert anna.post(f"/api/contacts/{contact_id()}/requests", {"kind": "refine"}).status_code == 201
    detail = anna.contact(contact_id())
    [version], [decision], [request] = detail["versions"], detail["decisions"], detail["requests"]
    sent = {"ContactDetail": detail, "Contact": detail["contact"], "Version": version, "ImageMark": version["mark"]}
    sent |= {"Decision": decision, "Delivery": decision["delivery"], "VehicleRequest": request}
    for name, record in sent.items():
        [body] = re.findall(rf"^interface {name} {{\n(.*?)^}}", text, re.DOTALL | re.MULTILINE)
        assert set(re.findall(r"^  (\w+):", body, re.MULTILINE)) == set(record), name
