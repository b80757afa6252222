"""Files of the page: the browser loads all scripts at once, and there are no others."""

from __future__ import annotations

import re
from pathlib import Path

from sonarpost.services.console.web.server import STATIC

SCRIPTS = STATIC / "js"
PAGES = ("login.js", "password.js", "offline.js")
"""Scripts of other pages than the console."""


def imported(script: Path, found: set[Path]) -> set[Path]:
    """The scripts that a script imports, with itself."""
    found.add(script)
    for name in re.findall(r'^import .*?from "(\.[^"]+)";', script.read_text(), re.MULTILINE):
        other = (script.parent / name).resolve()
        if other not in found:
            imported(other, found)
    return found


def test_page_preloads_the_scripts_that_it_imports():
    page = (STATIC / "index.html").read_text()
    preloaded = set(re.findall(r'<link rel="modulepreload" href="/static/js/([^"]+)">', page))
    start = (SCRIPTS / "app.js").resolve()
    expected = {str(path.relative_to(SCRIPTS.resolve())) for path in imported(start, set()) - {start}}
    assert preloaded == expected


def test_every_script_is_imported_by_a_page():
    used: set[Path] = set()
    for name in ("app.js", *PAGES):
        imported((SCRIPTS / name).resolve(), used)
    languages = {path.resolve() for path in (SCRIPTS / "texts").glob("*.js")}
    assert {path.resolve() for path in SCRIPTS.rglob("*.js")} - used - languages == set()
