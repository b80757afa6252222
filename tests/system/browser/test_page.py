"""The console's page in a real browser: reviewed by keyboard alone, by two at once, cut off, and with hostile text."""

from __future__ import annotations

import pytest
from builders.common import REPOSITORY, eventually
from builders.console import PASSWORD, picture_record

CONTRAST = """() => {
  const channel = c => { const v = c / 255; return v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; };
  const rgb = words => words.match(/[0-9.]+/g).map(Number);
  const luminance = ([r, g, b]) => 0.2126 * channel(r) + 0.7152 * channel(g) + 0.0722 * channel(b);
  const ground = element => {
    for (let e = element; e; e = e.parentElement) {
      const colour = rgb(getComputedStyle(e).backgroundColor);
      if (colour.length === 3 || colour[3] > 0) return colour;
    }
    return [255, 255, 255];
  };
  const found = [];
  let seen = 0;
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const element = walker.currentNode.parentElement;
    const words = walker.currentNode.textContent.trim().slice(0, 40);
    if (!words || !element.checkVisibility() || !element.getClientRects().length) continue;
    const style = getComputedStyle(element);
    const [a, b] = [luminance(rgb(style.color)), luminance(ground(element))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const size = parseFloat(style.fontSize);
    const large = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
    seen += 1;
    if (ratio < (large ? 3 : 4.5)) found.push([words, ratio.toFixed(2), style.color]);
  }
  return [seen, found];
}"""

DRAWN = "() => document.querySelector('.map canvas').width > 300"

UNNAMED = """() => [...document.querySelectorAll('button, input, select, textarea, canvas, a, [role=option], img')]
  .filter(e => e.checkVisibility() && !e.closest('[aria-hidden=true]'))
  .filter(e => !(e.ariaLabel || e.getAttribute('alt') !== null || e.innerText?.trim()))
  .filter(e => !(e.labels?.length && e.labels[0].innerText.trim()))
  .map(e => e.outerHTML.slice(0, 120))"""


def few(served, count=6):
    for number in range(count):
        served.board.take_image(
            picture_record(
                f"000{number}", seed=10 * number, place=(56.0 + 0.001 * number, -5.0), atd_confidence=0.3 * number
            )
        )


def contact_ids(served):
    from sonarpost.services.console.store.contacts import Filter

    return {row["image_id"]: row["id"] for row in served.board.contacts(Filter(limit=500))["items"]}


def decisions(served, image_id):
    return served.board.contact(contact_ids(served)[image_id])["decisions"]


def row(image_id):
    return f'.row[data-id*=".{image_id}"]'


def test_a_whole_review_by_keys_alone(served):
    few(served)
    there = served.visit("", path="login")
    there.page.keyboard.type("anna")
    there.press("Tab")
    there.page.keyboard.type(PASSWORD)
    there.press("Enter")
    there.shows("0005")
    assert there.text("#unreviewed").startswith("6 ")
    there.press("j")
    there.shows("0004")
    there.press("k", "e")
    there.shows("0005")
    # Verdict, how sure, remark, send.
    there.press("1", "g", "End", "w")
    there.page.keyboard.type("1 clear edge, long shadow")
    there.press("Control+Enter")
    there.wait(".now .badge.mine_like")
    [decision] = decisions(served, "0005")
    assert (decision["verdict"], decision["confidence"], decision["remark"]) == (
        "mine_like",
        1.0,
        "1 clear edge, long shadow",
    )
    assert decision["operator"] == "anna"
    there.page.locator(row("0005")).wait_for(state="detached")  # decided: it leaves the list of what is to do
    # What it says was on the screen was.
    entry = served.board.contact(contact_ids(served)["0005"])["audit"][-1]
    assert (entry["action"], entry["user"], entry["version"]) == ("decide", "anna", 1)
    there.press("u")
    there.wait(".now .badge.unreviewed")
    assert [d["undoes"] for d in decisions(served, "0005")] == [decision["decision_id"], None]
    # Ask for more: the cost first, then the order.
    there.press("r")
    there.wait("dialog .costs")
    assert "air time" in there.text("dialog .costs")
    assert there.page.locator("dialog .costs input[value=wider]:not([disabled])").count() == 1
    there.press("ArrowDown", "Enter")
    there.wait('details[data-name="requests"] >> text=/resend|revisit/')
    # The other views, and back.
    there.press("n", "p")
    there.until(DRAWN)
    there.press("j", "Enter")
    there.shows("0000")
    there.press("f", "q", "t", "z", "?")
    there.wait("dialog .keys")
    there.press("Escape")
    there.press("x")
    there.wait("dialog .exports a")
    there.press("Escape")
    assert there.page.evaluate("document.documentElement.dataset.theme") == "night"


def test_measuring_by_keys_and_its_lock_on_what_is_made_up(served):
    # The last quarter of the picture was never received.
    served.board.take_image(picture_record("00A7", missing_rows=10))
    there = served.visit()
    there.shows("00A7")
    assert there.pixels() > 1000
    there.press("m", "m", "m")
    there.wait(".hint >> text=shadow")
    there.press("Enter", *["Shift+ArrowRight"] * 3, "Enter")
    there.wait(".hint >> text=Enter keeps it")
    there.press("Enter")
    there.wait('details[data-name="measurements"] >> text=/shadow 0.75/')
    [kept] = served.board.contact(contact_ids(served)["00A7"])["measurements"]
    assert kept["value_m"] == pytest.approx(0.75)
    assert kept["height_m"] == pytest.approx(0.75 * 5.0 / (13.0 + 0.75), rel=0.02)
    assert f"height {kept['height_m']:.2f} ± {kept['height_sigma_m']:.2f}" in there.text(
        'details[data-name="measurements"]'
    )
    # Across the gap it is refused, and nothing is kept.
    there.may_say("409")
    there.press("m", "Enter", *["Shift+ArrowDown"] * 3, "Enter")
    there.wait("#toasts .bad")
    there.press("Escape")
    assert len(served.board.contact(contact_ids(served)["00A7"])["measurements"]) == 1
    # On the enhanced layer it is locked, and the strip says why.
    there.press("e")
    there.wait(".strip .made >> text=not a measurement")
    there.press("m")
    there.wait("#toasts >> text=Measuring is locked")
    assert there.page.locator(".hint").count() == 0
    assert there.page.locator('[data-tool="measure"]').get_attribute("aria-disabled") == "true"


def test_the_strip_says_what_came_and_what_did_not(served):
    served.board.take_image(picture_record("00A7", missing_rows=10))
    there = served.visit()
    there.shows("00A7")
    strip = there.text(".strip")
    assert "emb" in strip
    assert "150 of 200" in strip
    assert "75" in strip
    assert "25" in strip
    assert "never received" in strip
    with_hatch = there.page.locator("canvas").first.screenshot()
    there.press("h")
    there.until("() => document.querySelector('[data-tool=hatch]').ariaPressed === 'false'")
    assert there.page.locator("canvas").first.screenshot() != with_hatch


def test_a_contact_is_refined_while_it_is_looked_at(served):
    served.board.take_image(picture_record("00A7", 1, missing_rows=20))
    there = served.visit()
    there.shows("00A7")
    assert "50" in there.text(row("00A7"))
    served.board.take_image(picture_record("00A7", 2))
    there.until("() => document.querySelector('canvas').dataset.shows.endsWith(' 2 raw')")
    there.wait(f"{row('00A7')} >> text=100")
    # An older version stays where it was put.
    there.press("[")
    there.until("() => document.querySelector('canvas').dataset.shows.endsWith(' 1 raw')")
    served.board.take_image(picture_record("00A7", 3))
    there.wait(".versions >> text=Version 3 is newer")
    assert there.page.evaluate("document.querySelector('canvas').dataset.shows").endswith(" 1 raw")
    # And a picture does not change below a measurement.
    there.press("]", "]")
    there.until("() => document.querySelector('canvas').dataset.shows.endsWith(' 3 raw')")
    there.press("m", "Enter")
    served.board.take_image(picture_record("00A7", 4))
    there.wait(".versions >> text=Version 4 is newer")
    assert there.page.evaluate("document.querySelector('canvas').dataset.shows").endswith(" 3 raw")
    there.press("s")
    there.until("() => !document.querySelectorAll('canvas')[1].classList.contains('hidden')")


def test_two_operators_at_once(served):
    few(served, 2)
    anna, bo = served.visit("anna"), served.visit("bo")
    anna.shows("0001")
    bo.shows("0001")
    anna.press("1")
    anna.wait("#send:enabled")
    bo.press("2", "w")
    bo.page.keyboard.type("a rock")
    bo.press("Control+Enter")
    # Anna's page shows it, and asks before hers replaces it.
    anna.wait(".now .badge.not_mine_like")
    anna.may_say("409")
    anna.press("Enter")
    anna.wait("dialog >> text=somebody was faster")
    assert "a rock" in anna.text("dialog")
    assert [d["operator"] for d in decisions(served, "0001")] == ["bo"]
    anna.page.get_by_role("button", name="Replace it").click()
    anna.wait(".now .badge.mine_like")
    bo.wait(".now .badge.mine_like")
    assert [d["operator"] for d in decisions(served, "0001")] == ["anna", "bo"]


def test_a_dropped_connection_recovers(served):
    few(served, 2)
    there = served.visit()
    there.may_say("Failed to load resource", "ERR_", "500", "net::")
    there.shows("0001")
    served.stop()
    there.wait("#offline")
    assert "old" in there.text("#offline")
    assert there.text("#live") == "not live"
    # What happens meanwhile is there afterwards.
    served.board.take_image(picture_record("00ZZ", seed=99))
    served.start_again()
    there.wait(row("00ZZ"))
    there.until("() => !document.getElementById('offline')")
    served.board.take_image(picture_record("00ZY", seed=98))
    there.wait(row("00ZY"))
    assert there.text("#live") == "live"


HOSTILE = '<img src=x onerror="window.hurt=1"><script>window.hurt=2</script>'


def test_hostile_text_is_text(served):
    served.board.take_image(picture_record("00A7", atd_class=HOSTILE[:60], line_name=HOSTILE, sonar_id=HOSTILE))
    there = served.visit()
    there.shows("00A7")
    there.press("1", "w")
    there.page.keyboard.type(HOSTILE)
    there.press("Control+Enter")
    there.wait(".now .remark")
    assert HOSTILE in there.text(".now .remark")
    # Somebody else sees it, with the class that an expert made up, in every place that shows it.
    with_record = served.visit("bo")
    with_record.press("l")
    with_record.shows("00A7")
    for summary in with_record.page.locator("summary").all():
        summary.click()
    with_record.press("p")
    with_record.until(DRAWN)
    with_record.press("j")
    with_record.wait(".map .card")
    with_record.press("f", "q")
    for page in (there.page, with_record.page):
        assert page.evaluate("window.hurt") is None
        assert page.locator("main img[src='x'], main script").count() == 0
    report = served.visit("bo", path=f"report/{contact_ids(served)['00A7']}")
    assert HOSTILE in report.page.inner_text("body")
    assert report.page.evaluate("window.hurt") is None


def test_who_may_only_look(served):
    few(served, 1)
    there = served.visit("watch")
    there.shows("0000")
    there.press("1")
    there.wait("#toasts >> text=may look")
    assert there.page.locator("#send").is_disabled()
    there.press("m")
    there.wait("#toasts >> text=Measuring is locked")
    assert decisions(served, "0000") == []


def test_without_a_session_there_is_the_log_in_page(served):
    there = served.visit("")
    there.wait("#login")
    there.may_say("401")
    there.page.fill("#user", "anna")
    there.page.fill("#password", "not the password")
    there.press("Enter")
    there.until("() => document.getElementById('problem').textContent !== ''")


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_contrast_and_names(served, theme):
    few(served)
    served.board.take_image(picture_record("00A7", missing_rows=10))
    there = served.visit(color_scheme=theme)
    there.shows("00A7")
    there.press("2", "Enter")
    there.wait("#toasts p")
    there.press("l", "e", "1")
    there.wait(".strip .made")
    assert there.page.evaluate("document.documentElement.dataset.theme") == ("night" if theme == "dark" else "day")
    views = {
        "review": [],
        "ask": ["r"],
        "keys": ["Escape", "?"],
        "exports": ["Escape", "x"],
        "map": ["Escape", "p", "j"],
        "fleet": ["f"],
    }
    marks = {"ask": "dialog .costs", "keys": "dialog .keys", "exports": "dialog .exports", "map": ".map .card"}
    for name, keys in views.items():
        for key in keys:
            there.press(key)
            if key == "p":
                there.until(DRAWN)
        if name in marks:
            there.wait(marks[name])
        seen, low = there.page.evaluate(CONTRAST)
        assert seen > 10, name
        assert low == [], name
        assert there.page.evaluate(UNNAMED) == [], name
    # The page for one's password has the same theme, with everything wrong.
    there.page.goto(served.address + "password")
    there.wait("button[type=submit]:enabled")
    assert there.page.evaluate("document.documentElement.dataset.theme") == ("night" if theme == "dark" else "day")
    there.page.fill("#again", "another")
    there.press("Enter")
    there.wait("#again-problem:has-text('differ')")
    seen, low = there.page.evaluate(CONTRAST)
    assert (seen > 10, low, there.page.evaluate(UNNAMED)) == (True, [], [])
    there.page.fill("#old", PASSWORD)
    there.page.fill("#new", "another fine one")
    there.page.fill("#again", "another fine one")
    there.press("Enter")
    there.wait("#done:has-text('changed')")
    assert there.page.evaluate(CONTRAST)[1] == []


def test_thousands_of_contacts(served):
    from sonarpost.services.console.store import contacts

    with served.board.database.writing() as db:
        for number in range(5000):
            record = picture_record(f"{number:04d}", seed=number % 7, place=None, atd_confidence=number / 2500)
            contacts.take_image(db, record, None, 1_700_000_000.0 + number, 8.0)
    there = served.visit()
    there.shows("4999")
    assert there.text("#unreviewed") == "5000 to review of 5000"
    # A list of 5,000 whose rows exist only where they are seen.
    assert there.page.locator(".row").count() < 40
    assert there.page.locator(".row").first.get_attribute("aria-setsize") == "5000"
    there.page.evaluate("document.getElementById('queue').scrollTop = 1e9")
    there.wait(row("0000"))
    assert there.page.locator(".row").count() < 40
    there.press("/")
    there.page.keyboard.type("4321")
    there.wait(".filters .sum >> text=1 of 5000 shown")
    there.press("Escape", "j")
    there.shows("4321")


def test_expert_advice_appears_beside_the_picture(serve):
    from sonarpost.messages import Advice
    from sonarpost.services.console.store.contacts import Filter

    vessel = serve()
    few(vessel, 1)
    there = vessel.visit()
    there.shows("0000")
    advice = Advice(
        advice_id="a-1",
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        image_id="0000",
        image_version=1,
        verdict="mine_like",
        confidence=0.9,
        mlo_class="manta",
        remark="seen before, mark 3",
        author="eva",
        advised_utc_s=1_700_000_100.0,
    )
    vessel.board.take_advice(advice)
    there.wait(".advice >> text=seen before, mark 3")
    # Ashore the same page lets an expert give it.
    shore = serve(role="shore")
    few(shore, 1)
    expert = shore.visit("eva")
    expert.shows("0000")
    assert "advice" in expert.text("legend").lower()
    expert.press("1", "w")
    expert.page.keyboard.type("have a second look")
    expert.press("Control+Enter")
    contact_id = shore.board.contacts(Filter())["items"][0]["id"]
    eventually(lambda: len(shore.board.contact(contact_id)["advice"]) == 1, what="the advice")
    expert.wait(".advice >> text=have a second look")


def test_every_key_is_in_the_documents(served):
    few(served, 1)
    there = served.visit()
    there.press("?")
    there.wait("dialog .keys")
    page = REPOSITORY / "docs" / "explanation" / "console.md"
    section = page.read_text("utf-8").split("## Screens and keys")[1].split("\n## ")[0]
    keys = set(there.page.locator("dialog .keys kbd").all_inner_texts())
    assert len(keys) > 25
    assert {key for key in keys if f"`{key}`" not in section} == {"arrows"}
