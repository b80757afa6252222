"""Every element at seven sizes, in three languages and two browsers, with scroll bars; numbers of the language."""

import re

import pytest
from builders.console import image_record
from builders.layout_faults import FAULTS

SIZES = ((390, 844), (1024, 768), (1280, 720), (1366, 768), (1440, 900), (1920, 1080), (2560, 1440))
VIEWS = {"q": ".review", "p": ".map", "f": ".fleet"}
FOREIGN_NUMBER = {"en": r"\d,\d{1,2}(?!\d)", "de": r"\d\.\d{1,2}(?!\d)", "fr": r"\d\.\d|\d,\d{3}(?!\u2032)"}
"""Numbers with the separators of another language."""


@pytest.mark.firefox
@pytest.mark.parametrize("language", FOREIGN_NUMBER)
def test_no_element_is_cut_off_and_numbers_are_those_of_the_language(served, language):
    for number in range(12):
        record = image_record(f"00{number:02d}", seed=number, missing_rows=10 * (number % 2), total=16108)
        served.state.store_image(record)
    served.users.store_settings("anna", {"language": language})
    visit = served.visit()
    visit.wait_for_contact("0011")
    assert visit.page.evaluate("document.documentElement.lang") == language
    list_ = "document.getElementById('queue')"
    visit.until(f"() => {list_}.offsetWidth > {list_}.clientWidth")  # the scroll bar takes space
    found: list[str] = []
    for size in SIZES:
        visit.resize(*size)
        for key, view in VIEWS.items():
            visit.press(key)
            visit.page.locator(view).wait_for()
            visit.settle()
            found += [f"{size} {view}: {fault}" for fault in visit.page.evaluate(FAULTS)]
            text = visit.page.inner_text("body")
            found += [f"{view}: {number}" for number in re.findall(FOREIGN_NUMBER[language], text)]
        visit.press("q")
    assert not found, "\n".join(found)
