"""The page for one's own password in a real browser: by keys alone, with everything that can be wrong."""

from __future__ import annotations

from builders.console import PASSWORD, picture_record

NEW = "another fine one"
FOCUSED = "() => document.activeElement.id"


def fill(there, *values):
    """Type into the three fields, from the first one on, and send."""
    there.page.focus("#old")
    for number, value in enumerate(values):
        there.press(*["Tab"] if number else [], "Control+a", "Delete")
        there.page.keyboard.type(value)
    there.press("Enter")


def test_from_the_header_to_a_new_password_by_keys_alone(served):
    served.board.take_image(picture_record("00A7"))
    there, elsewhere, another = served.visit("anna"), served.visit("anna"), served.visit("bo")
    there.shows("00A7")
    # A remark that is not sent yet is there still: the page opens beside this one.
    there.press("1", "w")
    there.page.keyboard.type("half a remark")
    there.press("Escape")
    there.page.focus("#bar nav button:last-child")
    for _ in range(20):
        there.press("Tab")
        if there.page.evaluate(FOCUSED) == "to-password":
            break
    with there.page.context.expect_page() as opened:
        there.press("Enter")
    page = opened.value
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
    assert served.users.right("anna", NEW)
    assert there.page.input_value("#remark") == "half a remark"
    # Other sessions are led to the log-in, without being touched; this one goes on, and so does another person's.
    elsewhere.may_say("401")
    elsewhere.wait("#login")
    page.click("nav a")
    page.wait_for_selector("#unreviewed")
    assert there.page.locator("#unreviewed").count() == another.page.locator("#unreviewed").count() == 1


def test_what_is_wrong_is_said_beside_its_field(served):
    there = served.visit(path="password")
    there.wait("button[type=submit]:enabled")
    assert there.text("#new-hint") == "10 to 200 characters"
    # What the page knows by itself it does not ask for.
    asked = []
    there.page.on("request", lambda request: asked.append(request.url))
    fill(there, "", "short", "shorter")
    assert "missing" in there.text("#old-problem")
    assert there.text("#new-problem") == "a password has 10 to 200 characters; this one has 5"
    assert "differ" in there.text("#again-problem")
    assert there.page.evaluate(FOCUSED) == "old"
    assert asked == []
    fill(there, PASSWORD, NEW, NEW + "s")
    assert [there.text(f"#{name}-problem") for name in ("old", "new")] == ["", ""]
    assert there.page.evaluate(FOCUSED) == "again"
    assert there.page.get_attribute("#again", "aria-invalid") == "true"
    assert "again-problem" in there.page.get_attribute("#again", "aria-describedby")
    # The words go when the field is mended.
    there.press("Backspace")
    assert there.text("#again-problem") == ""
    assert there.page.get_attribute("#again", "aria-invalid") is None
    there.may_say("403", "429")
    fill(there, "not it at all", NEW, NEW)
    there.wait("#old-problem:has-text('this is not your present password')")
    assert there.page.evaluate(FOCUSED) == "old"
    assert there.page.input_value("#new") == NEW, "what was right need not be typed again"
    for _ in range(4):
        fill(there, "not it at all", NEW, NEW)
        there.wait("#old-problem:has-text('not your present')")
    fill(there, PASSWORD, NEW, NEW)
    there.wait("#problem:has-text('wait')")
    assert served.users.right("anna", PASSWORD)


def test_out_by_the_header_of_this_page(served):
    there = served.visit(path="password")
    there.page.get_by_role("button", name="anna: log out").click()
    there.wait("#login")
    there.page.goto(served.address + "password")
    there.wait("#login")


def test_the_page_fits_in_a_small_window_with_large_type(served):
    there = served.visit(path="password", viewport={"width": 480, "height": 360})
    there.page.evaluate("localStorage.setItem('sonarpost.type', 'large')")
    there.page.reload()
    there.wait("button[type=submit]:enabled")
    there.page.focus("button[type=submit]")
    assert there.page.locator("button[type=submit]").bounding_box()["y"] < 360
    there.page.focus("#old")
    assert there.page.locator("label[for=old]").bounding_box()["y"] > 0
