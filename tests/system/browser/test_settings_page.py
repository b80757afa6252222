"""Settings and keys of the user, the page without its server, and the first use by a log-in link."""

import pytest
from builders.common import eventually
from builders.console import image_record, session_cookie

pytestmark = pytest.mark.parametrize("browser", ["chromium"], indirect=True)


def open_page(served, user="anna"):
    for number in range(3):
        served.state.store_image(image_record(f"000{number}"))
    visit = served.visit(user)
    visit.wait_for_contact("0002")
    return visit


def test_settings_follow_the_user_to_another_computer(served):
    here = open_page(served)
    here.page.click("#menu")
    here.page.click("[data-item=theme]")
    here.page.click("#menu")
    here.page.click("[data-item=type_size]")
    here.open_dialog("settings")
    here.page.locator(".settings select").select_option("de")
    here.until("() => document.documentElement.lang === 'de'")
    stored = {"theme": "night", "type": "large", "language": "de"}
    eventually(lambda: stored.items() <= served.users.settings("anna").items(), what="the settings")
    # Another computer, with another cache.
    there = open_page(served)
    assert there.page.evaluate("({ ...document.documentElement.dataset })") == {"theme": "night", "type": "large"}
    assert there.page.evaluate("document.documentElement.lang") == "de"
    # Another user in the same browser has settings of their own.
    here.page.context.add_cookies(
        [
            {
                "name": session_cookie(served.address),
                "value": served.users.start_session("bo").token,
                "url": served.address,
            }
        ]
    )
    here.page.reload()
    here.wait_for_contact("0002")
    assert here.page.evaluate("document.documentElement.dataset.theme") == "day"
    assert here.page.evaluate("document.documentElement.lang") == "en"


def test_single_character_keys_are_switched_off(served):
    visit = open_page(served)
    visit.open_dialog("settings")
    visit.page.check("#keys-off")
    visit.press("Escape", "j", "p", "?", "1")
    assert visit.page.locator("dialog").count() == 0
    assert visit.page.locator(".map").is_hidden()
    assert visit.text(".heading h2").endswith("0002")
    # Buttons show no keys that are off.
    assert visit.page.locator(".verdicts kbd").first.is_hidden()
    # Keys that are no characters remain.
    visit.page.focus("#queue")
    visit.press("ArrowDown")
    visit.wait_for_contact("0001")
    visit.open_dialog("settings")
    visit.page.uncheck("#keys-off")
    visit.press("Escape", "k")
    visit.wait_for_contact("0002")
    assert visit.page.locator(".verdicts kbd").first.is_visible()
    assert served.decisions("0002") == []


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
    # The page tries again by itself.
    served.restart()
    visit.wait_for_contact("0002")


def test_back_returns_to_the_view_and_contact_before_and_a_reload_keeps_them(served):
    visit = open_page(served)
    visit.press("j")
    visit.wait_for_contact("0001")
    visit.press("p", "f")
    visit.page.locator(".fleet").wait_for()
    visit.page.reload()
    visit.page.locator(".fleet").wait_for()
    visit.wait_for_contact("0001")
    visit.page.go_back()
    visit.page.locator(".map").wait_for()
    visit.page.go_back()
    visit.page.locator(".review").wait_for()
    assert visit.text(".heading h2").endswith("0001")
    visit.page.go_back()
    visit.wait_for_contact("0002")
    visit.page.go_forward()
    visit.wait_for_contact("0001")
    # An address that is no contact opens the first one.
    visit.expect_errors("status of 404")
    visit.page.goto(f"{served.address}#none%")
    visit.page.reload()
    visit.wait("#toasts >> text=none% could not be loaded")
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
