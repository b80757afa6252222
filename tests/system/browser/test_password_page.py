"""The password page in a real browser: keyboard operation and all errors."""

from __future__ import annotations

from builders.console import PASSWORD, image_record

NEW = "another fine one"
FOCUSED = "() => document.activeElement.id"


def fill(visit, *values):
    """Fill the three fields and submit."""
    visit.page.focus("#old")
    for number, value in enumerate(values):
        visit.press(*["Tab"] if number else [], "Control+a", "Delete")
        visit.page.keyboard.type(value)
    visit.press("Enter")


def test_password_change_with_the_keyboard(served):
    served.state.store_image(image_record("00A7"))
    visit, elsewhere, another = served.visit("anna"), served.visit("anna"), served.visit("bo")
    visit.wait_for_contact("00A7")
    # The page opens in a new tab, so that an unsent remark is kept.
    visit.press("Shift+Digit1", "w")
    visit.page.keyboard.type("half a remark")
    visit.press("Escape")
    visit.page.focus("#bar nav button:last-child")
    for _ in range(20):
        visit.press("Tab")
        if visit.page.evaluate(FOCUSED) == "to-password":
            break
    with visit.page.context.expect_page() as opened:
        visit.press("Enter")
    page = opened.value
    page.bring_to_front()  # Playwright leaves a new tab of Firefox without the focus
    page.wait_for_selector("button[type=submit]:enabled")
    assert page.url == served.address + "password"
    assert page.evaluate(FOCUSED) == "old"
    assert page.inner_text("#platform") == "vessel-1"
    for value in (PASSWORD, NEW, NEW):
        page.keyboard.type(value)
        page.keyboard.press("Tab")
    assert page.evaluate("document.activeElement.type") == "submit"
    page.keyboard.press("Enter")
    page.wait_for_selector("#done:has-text('Your password is changed')")
    assert page.evaluate(FOCUSED) == "done"
    assert [page.input_value(f"#{name}") for name in ("old", "new", "again")] == ["", "", ""]
    assert served.users.verify_password("anna", NEW)
    assert visit.page.input_value("#remark") == "half a remark"
    # The other session of the user ends. This one and the session of another user continue.
    elsewhere.expect_errors("401")
    elsewhere.wait("#login")
    page.click("nav a")
    page.wait_for_selector("#unreviewed")
    assert visit.page.locator("#unreviewed").count() == another.page.locator("#unreviewed").count() == 1


def test_error_is_displayed_at_its_field(served):
    visit = served.visit(path="password")
    visit.wait("button[type=submit]:enabled")
    assert visit.text("#new-hint") == "10 to 200 characters"
    # The page checks these errors without a request.
    requests = []
    visit.page.on("request", lambda request: requests.append(request.url))
    fill(visit, "", "short", "shorter")
    assert "missing" in visit.text("#old-problem")
    assert visit.text("#new-problem") == "a password has 10 to 200 characters; this one has 5"
    assert "differ" in visit.text("#again-problem")
    assert visit.page.evaluate(FOCUSED) == "old"
    assert requests == []
    fill(visit, PASSWORD, NEW, NEW + "s")
    assert [visit.text(f"#{name}-problem") for name in ("old", "new")] == ["", ""]
    assert visit.page.evaluate(FOCUSED) == "again"
    assert visit.page.get_attribute("#again", "aria-invalid") == "true"
    assert "again-problem" in visit.page.get_attribute("#again", "aria-describedby")
    # The error disappears when the field is corrected.
    visit.press("Backspace")
    assert visit.text("#again-problem") == ""
    assert visit.page.get_attribute("#again", "aria-invalid") is None
    visit.expect_errors("403", "429")
    fill(visit, "not it at all", NEW, NEW)
    visit.wait("#old-problem:has-text('this is not your current password')")
    assert visit.page.evaluate(FOCUSED) == "old"
    assert visit.page.input_value("#new") == NEW, "a valid field keeps its value"
    for _ in range(4):
        fill(visit, "not it at all", NEW, NEW)
        visit.wait("#old-problem:has-text('not your current')")
    fill(visit, PASSWORD, NEW, NEW)
    visit.wait("#problem:has-text('too many failed attempts: try again in')")
    assert served.users.verify_password("anna", PASSWORD)


def test_page_fits_a_small_window_with_large_type_and_logs_out(served):
    visit = served.visit(path="password", viewport={"width": 480, "height": 360})
    visit.page.evaluate("localStorage.setItem('sonarpost.type', 'large')")
    visit.page.reload()
    visit.wait("button[type=submit]:enabled")
    visit.page.focus("button[type=submit]")
    assert visit.page.locator("button[type=submit]").bounding_box()["y"] < 360
    visit.page.focus("#old")
    assert visit.page.locator("label[for=old]").bounding_box()["y"] > 0
    visit.page.get_by_role("button", name="anna: log out").click()
    visit.wait("#login")
    visit.page.goto(served.address + "password")
    visit.wait("#login")
