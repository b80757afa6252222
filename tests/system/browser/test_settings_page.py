"""Settings and keys of the user, the page without its server, and the first use by a log-in link."""

from __future__ import annotations

import pytest
from builders.common import eventually
from builders.console import image_record

pytestmark = pytest.mark.parametrize("browser", ["chromium"], indirect=True)


def open_page(served, user="anna"):
    for number in range(3):
        served.state.store_image(image_record(f"000{number}"))
    visit = served.visit(user)
    visit.wait_for_contact("0002")
    return visit


def field(visit, action):
    return visit.page.locator(f'.key-field[data-action="shortcuts.{action}"]')


def test_settings_follow_the_user_to_another_computer(served):
    here = open_page(served)
    here.press(";")
    here.page.locator(".settings select").nth(1).select_option("night")
    here.page.locator(".settings select").nth(2).select_option("large")
    here.page.locator(".settings select").nth(0).select_option("de")
    here.until("() => document.documentElement.lang === 'de'")
    stored = {"theme": "night", "type": "large", "language": "de"}
    eventually(lambda: stored.items() <= served.users.settings("anna").items(), what="the settings")
    # Another computer, with another cache.
    there = open_page(served)
    assert there.page.evaluate("({ ...document.documentElement.dataset })") == {"theme": "night", "type": "large"}
    assert there.page.evaluate("document.documentElement.lang") == "de"
    # Another user in the same browser has settings of their own.
    here.page.context.add_cookies(
        [{"name": "sonarpost_session", "value": served.users.start_session("bo").token, "url": served.address}]
    )
    here.page.reload()
    here.wait_for_contact("0002")
    assert here.page.evaluate("document.documentElement.dataset.theme") == "day"
    assert here.page.evaluate("document.documentElement.lang") == "en"


def test_key_is_changed_and_a_used_key_is_refused_by_name(served):
    visit = open_page(served)
    visit.press(";")
    field(visit, "queue.next").focus()
    visit.press("k")
    visit.wait("dialog [role=alert]:has-text('“k” is the key of “previous contact”.')")
    assert field(visit, "queue.next").input_value() == "j"
    # The same key in another view is not a conflict.
    field(visit, "queue.next").focus()
    visit.press("$")
    assert field(visit, "queue.next").input_value() == "$"
    assert visit.text("dialog [role=alert]") == ""
    visit.press("Escape", "j")
    visit.press("$")
    visit.wait_for_contact("0001")
    # The help shows the present key, and buttons do not show default keys.
    visit.press("?")
    assert "next contact\n$" in visit.text("dialog .keys").replace("\n\n", "\n")
    visit.press("Escape")
    assert visit.page.locator(".verdicts kbd").first.is_hidden()
    visit.page.reload()
    visit.wait_for_contact("0001")
    visit.press("k")
    visit.wait_for_contact("0002")
    visit.press("$")
    visit.wait_for_contact("0001")
    visit.press(";")
    visit.page.click("#keys-reset")
    assert field(visit, "queue.next").input_value() == "j"


def test_single_character_keys_are_switched_off(served):
    visit = open_page(served)
    visit.press(";")
    visit.page.check("#keys-off")
    visit.press("Escape", "j", "p", "?", ";")
    assert visit.page.locator("dialog").count() == 0
    assert visit.page.locator(".map").is_hidden()
    assert visit.text(".heading h2").endswith("0002")
    # Keys that are no characters remain.
    visit.page.focus("#queue")
    visit.press("ArrowDown")
    visit.wait_for_contact("0001")
    visit.page.click("#settings")
    visit.page.uncheck("#keys-off")
    visit.press("Escape", "k")
    visit.wait_for_contact("0002")


def test_without_the_server_the_page_names_it(served):
    visit = open_page(served)
    ready = "async () => (await navigator.serviceWorker.ready).active.state === 'activated'"
    visit.until(ready)
    # The manifest is valid for an installation.
    manifest = visit.page.evaluate("fetch('/manifest.webmanifest').then(answer => answer.json())")
    for icon in manifest["icons"]:
        assert visit.page.evaluate("async path => (await fetch(path)).ok", icon["src"])
    visit.page.reload()
    visit.wait_for_contact("0002")
    cached = visit.page.evaluate(
        """async () => (await Promise.all((await caches.keys()).map(async name =>
          (await (await caches.open(name)).keys()).map(request => new URL(request.url).pathname)))).flat()"""
    )
    assert "/static/js/app.js" in cached
    assert [path for path in cached if not path.startswith("/static/")] == []
    visit.expect_errors("ERR_", "Failed to load", "fetch")
    served.stop()
    visit.page.reload()
    visit.wait("h1:has-text('No connection')")
    assert visit.text("#server") == served.address.split("/")[2]
    assert visit.page.evaluate("getComputedStyle(document.querySelector('.sheet')).borderTopStyle") == "solid"
    served.restart()
    visit.page.click("#again")
    visit.wait_for_contact("0002")


def test_log_in_link_leads_to_a_decision_without_a_form(served):
    served.state.store_image(image_record("00A7"))
    token = served.users.make_login_link("anna")
    visit = served.visit("", path=f"login#{token}")
    visit.wait_for_contact("00A7")
    visit.page.locator('[data-verdict="mine_like"]:enabled').wait_for()
    assert token not in visit.page.evaluate("location.href + JSON.stringify(performance.getEntries())")
    # The link is valid once, and the page names the reason.
    again = served.visit("", path=f"login#{token}")
    again.expect_errors("401")
    again.wait("#problem:has-text('was used before')")
    assert again.page.url == served.address + "login"
    again.page.evaluate("location.hash = 'wrong'")
    again.wait("#problem:has-text('not valid')")
