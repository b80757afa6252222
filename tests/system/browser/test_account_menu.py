"""The menu of the header in a real browser: password, log-out, session that has ended."""

from builders.console import PASSWORD, image_record

NEW = "another fine one"
FOCUSED = "() => document.activeElement.id"


def test_password_is_changed_in_a_dialog_of_the_menu(served):
    served.state.store_image(image_record("00A7"))
    visit, elsewhere = served.visit("anna"), served.visit("anna")
    visit.wait_for_contact("00A7")
    visit.press("w")
    visit.page.keyboard.type("half a remark")
    visit.press("Escape")
    visit.page.focus("#menu")
    visit.press("Enter", "Tab")
    assert visit.page.evaluate("() => document.activeElement.dataset.item") == "exports"
    visit.page.focus('.menu [data-item="password"]')
    visit.press("Enter")
    visit.wait("dialog[open]")
    assert visit.page.evaluate(FOCUSED) == "password-old"
    # The page finds these errors without a request.
    requests = []
    visit.page.on("request", lambda request: requests.append(request.url))
    problem = "#password-problem"
    for values, focused, text in (
        (("", "", ""), "password-old", "missing"),
        ((PASSWORD, "short", "short"), "password-new", "a password has 10 to 200 characters; this one has 5"),
        ((PASSWORD, NEW, NEW + "s"), "password-again", "differ"),
    ):
        for name, value in zip(("old", "new", "again"), values, strict=True):
            visit.page.fill(f"#password-{name}", value)
        visit.press("Enter")
        visit.wait(f'{problem} >> text="{text}"' if text.startswith("a ") else f"{problem} >> text={text}")
        assert visit.page.evaluate(FOCUSED) == focused
        assert visit.page.get_attribute(f"#{focused}", "aria-invalid") == "true"
    assert not [url for url in requests if "password" in url]
    visit.expect_errors("403")
    visit.page.fill("#password-old", "not it at all")
    visit.page.fill("#password-again", NEW)
    visit.press("Enter")
    visit.wait(f"{problem} >> text=This is not your current password.")
    assert visit.page.evaluate(FOCUSED) == "password-old"
    assert visit.page.input_value("#password-new") == NEW, "a valid field keeps its value"
    visit.page.fill("#password-old", PASSWORD)
    visit.press("Enter")
    visit.page.locator("dialog").wait_for(state="detached")
    visit.wait("#toasts >> text=Your password is changed")
    assert served.users.verify_password("anna", NEW)
    assert visit.page.input_value("#remark") == "half a remark"
    # The user's other session ends. Its page says so.
    elsewhere.expect_errors("401")
    elsewhere.wait("#reason >> text=Your session has ended.")


def test_log_in_states_why_and_in_the_language_of_the_page(served):
    visit = served.visit(user="")
    visit.wait("#reason >> text=the console shows contacts to known users only")
    visit.expect_errors("401")
    visit.page.evaluate("localStorage.setItem('sonarpost.language', 'de')")
    visit.page.reload()
    visit.page.fill("#user", "anna")
    visit.page.fill("#password", "wrong password")
    visit.press("Enter")
    visit.wait("#problem >> text=Benutzername oder Passwort falsch.")
    visit.page.fill("#password", PASSWORD)
    visit.press("Enter")
    visit.page.click("#menu")
    visit.page.click('.menu [data-item="log_out"]')
    visit.wait("#login")
    assert visit.page.url == served.address + "login"
