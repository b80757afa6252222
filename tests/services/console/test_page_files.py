"""Files of the page: the browser loads all scripts at once, and there are no others."""

import re

from sonarpost.services.console.web.server import STATIC, imported_scripts

SCRIPTS = STATIC / "js"
PAGES = [SCRIPTS / name for name in ("app.js", "login.js", "offline.js")]


def test_page_preloads_every_script_of_the_console(console):
    page = console.browser("anna").get("/").text
    links = re.findall(r'<link rel="modulepreload" href="/static/js/([^"]+)">', page)
    pages_and_languages = {"app.js", "login.js", "offline.js", "texts/de.js", "texts/fr.js"}
    assert set(links) == {path.relative_to(SCRIPTS).as_posix() for path in SCRIPTS.rglob("*.js")} - pages_and_languages
    assert len(links) == len(set(links)) > 30
    assert page.index(links[-1]) < page.index("/static/js/app.js")


def test_every_script_is_imported_by_a_page():
    used = {path for page in PAGES for path in (page.resolve(), *imported_scripts(page))}
    languages = {path.resolve() for path in (SCRIPTS / "texts").glob("*.js")}
    assert {path.resolve() for path in SCRIPTS.rglob("*.js")} - used - languages == set()
