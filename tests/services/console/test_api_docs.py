"""docs/specifications/console-api.md describes all routes and fields."""

from __future__ import annotations

import re

from builders.common import REPOSITORY
from builders.console import image_record

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"


def test_all_routes_are_documented(console):
    text = (REPOSITORY / "docs" / "specifications" / "console-api.md").read_text(encoding="utf-8")
    paths = [route.path for route in console.app.asgi._app.routes]
    assert len(paths) > 20
    for path in paths:
        *_, before, last = re.sub(r"\{(\w+):\w+\}", r"{\1}", path).split("/")
        known = {
            "/": "`GET /`",
            "/api/export/{name}": "/api/export/contacts.geojson",
            "/static": "`/static/`",
        }
        assert known.get(path, f"/{last}" if before in ("", "{version}") else f"{before}/{last}") in text, path
    for name in console.browser("watch").get("/api/info").json():
        assert f'"{name}"' in text


def test_all_fields_of_a_contact_are_documented(console):
    console.state.store_image(image_record())
    anna = console.browser("anna")
    anna.decide(ID)
    detail = anna.contact(ID)
    text = (REPOSITORY / "docs" / "specifications" / "console-api.md").read_text(encoding="utf-8")
    for part in (detail, detail["contact"], detail["versions"][0], detail["decisions"][0], detail["audit"][0]):
        for name in part:
            assert f'"{name}"' in text, name
