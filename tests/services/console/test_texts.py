"""Texts of the page: one catalogue, complete in every language."""

import re
from pathlib import Path
from typing import get_args

import pytest

from sonarpost.services.console.web.access import ErrorCode
from sonarpost.services.console.web.server import STATIC

TEXTS = STATIC / "js" / "texts"
LANGUAGES = ("de", "fr")
ENTRY = re.compile(r'^  "(?P<name>[^"]+)": (?P<text>.+),$', re.MULTILINE)
PLACEHOLDER = re.compile(r"\{(\w+)\}")
STRING = re.compile(r'"((?:[^"\\]|\\.)*)"')


def entries(language: str) -> list[tuple[str, str]]:
    return [(m["name"], m["text"]) for m in ENTRY.finditer((TEXTS / f"{language}.js").read_text())]


def forms(text: str) -> list[str]:
    """The forms of a text: one, or those for numbers."""
    return STRING.findall(text)


def sources() -> str:
    scripts = [path for path in STATIC.rglob("*.js") if path.parent != TEXTS and "vendor" not in path.parts]
    return "\n".join(path.read_text() for path in [*scripts, *STATIC.glob("*.html")])


def names_in_use() -> tuple[set[str], tuple[str, ...]]:
    """Whole names in the scripts, and beginnings of names that are made of parts."""
    text = sources()
    whole = set(re.findall(r'"([a-z_]+(?:\.[A-Za-z0-9_]+)+)"', text)) | set(re.findall(r"t\(`([^`$]+)`", text))
    parts = {made.split("${")[0] for made in re.findall(r"`([a-z_]+\.[^`]*\$\{[^`]*)`", text)}
    return whole, tuple(parts)


def test_names_are_unique():
    names = [name for name, _ in entries("en")]
    assert len(names) == len(set(names)) > 300


def test_every_line_of_a_catalogue_is_an_entry():
    for language in ("en", *LANGUAGES):
        lines = (TEXTS / f"{language}.js").read_text().splitlines()
        body = lines[lines.index("export default {") + 1 : lines.index("};")]
        others = [line for line in body if line.strip() and not line.startswith("  //") and not ENTRY.match(line)]
        assert others == []


@pytest.mark.parametrize("language", LANGUAGES)
def test_language_has_all_texts_with_their_values(language):
    english, other = dict(entries("en")), dict(entries(language))
    assert other.keys() == english.keys()
    for name, text in english.items():
        expected = {frozenset(PLACEHOLDER.findall(form)) for form in forms(text)}
        found = {frozenset(PLACEHOLDER.findall(form)) for form in forms(other[name])}
        assert found == expected, name


def test_every_used_text_exists_and_every_text_is_used():
    names = {name for name, _ in entries("en")}
    whole, parts = names_in_use()
    called = {name for name in re.findall(r'\bt\("([^"]+)"', sources()) if "." in name.strip(" .")}
    assert called - names == set()
    assert {name for name in names if name not in whole and not name.startswith(parts)} == set()


def test_every_error_code_of_the_server_has_a_text():
    codes = {name.split(".")[1] for name, _ in entries("en") if name.startswith("error.")}
    assert codes - {"busy_for"} == set(get_args(ErrorCode))


def test_scripts_have_no_other_texts():
    """Properties that users see are not literals."""
    literal = re.compile(r'\b(?:text|title|alt|placeholder|"aria-label"): "[A-Za-z]{2,}[^"]*"')
    exceptions = {'text: "Enter"'}
    found = {match[0] for match in literal.finditer(sources())} - exceptions
    assert found == set()


def test_catalogue_is_a_folder_of_the_page():
    assert {path.stem for path in Path(TEXTS).glob("*.js")} == {"en", *LANGUAGES}
