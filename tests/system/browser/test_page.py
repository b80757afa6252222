"""The page in a real browser: keyboard review, two operators, lost connection, hostile text."""

import re

import pytest
from builders.common import REPOSITORY, eventually
from builders.console import FIRST_UTC_S, PASSWORD, contact_ids, downlink_state, image_record
from builders.records import decision_record

from sonarpost.services.console.chain import RouterState
from sonarpost.services.console.store import contacts

HATCH_PIXELS = """() => {
  const canvas = document.querySelector('.stage canvas');
  const { data } = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height);
  let count = 0;
  for (let i = 0; i < data.length; i += 4) count += data[i] > 200 && data[i + 1] > 150 && data[i + 2] < 110;
  return count;
}"""
MAP_DRAWN = "() => document.querySelector('.map').dataset.drawn !== undefined"


def add_contacts(served, count=6):
    for number in range(count):
        place = {"position": (56.0 + 0.001 * number, -5.0), "atd_confidence": 0.3 * number}
        served.state.store_image(image_record(f"000{number}", seed=10 * number, **place))


def row(image_id):
    return f'.row[data-id*=".{image_id}"]'


@pytest.mark.firefox
def test_complete_review_with_the_keyboard(serve):
    served = serve(take_back_s=60)
    add_contacts(served)
    visit = served.visit("", path="login")
    visit.page.keyboard.type("anna")
    visit.press("Tab")
    visit.expect_errors("401")
    visit.page.keyboard.type("not the password")
    visit.press("Enter")
    visit.until("() => document.getElementById('problem').textContent !== ''")
    visit.page.fill("#password", PASSWORD)
    visit.press("Enter")
    visit.wait_for_contact("0005")
    assert visit.text("#to-do").startswith("6 ")
    visit.press("j")
    visit.wait_for_contact("0004")
    visit.press("k")
    visit.wait_for_contact("0005")
    # Remark, verdict.
    visit.press("w")
    visit.page.keyboard.type("1 clear edge, long shadow")
    visit.press("Escape")
    visit.decide("1")
    visit.wait("#result >> text=uuv-1/0005 ▲ mine-like")
    visit.wait_for_contact("0004")  # the next contact is displayed by itself
    [decision] = served.decisions("0005")
    found = [decision[name] for name in ("operator", "verdict", "remark")]
    assert found == ["anna", "mine_like", "1 clear edge, long shadow"]
    visit.page.locator(row("0005")).wait_for(state="detached")  # decided contacts leave the list "to do"
    # The audit contains the displayed version.
    entry = served.contact("0005")["audit"][-1]
    assert (entry["action"], entry["user"], entry["version"]) == ("decide", "anna", 1)
    visit.press("u")
    visit.wait_for_contact("0005")
    visit.wait("#result >> text=taken back")
    assert [d["undoes"] for d in served.decisions("0005")] == [decision["decision_id"], None]
    # A request: first its cost, then the command.
    visit.press("r")
    visit.wait("[data-request]:focus")
    assert "cost unknown" in visit.text("[data-request=expand]")
    visit.page.locator("[data-request=expand]").focus()
    visit.press("Enter")
    visit.wait("dialog >> text=The cost is not known")
    visit.press("Enter")
    visit.wait('details[data-name="requests"] >> text=Expanded view')
    # The other views, and back.
    visit.press("n", "p")
    visit.until(MAP_DRAWN)
    visit.press("j", "Enter")
    visit.wait_for_contact("0000")
    visit.press("f", "q", "?")
    visit.wait("dialog .keys")
    visit.press("Escape")
    visit.open_dialog("exports")
    visit.wait("dialog .exports a")
    export = visit.page.locator("dialog [data-export=csv]")
    if visit.is_firefox():
        # Playwright receives no event of a download from Firefox.
        export.click()
    else:
        with visit.page.expect_download() as download:
            export.click()
        assert download.value.suggested_filename == "contacts.csv"
    visit.wait("dialog .progress >> text=contacts.csv is saved")
    visit.press("Escape")


@pytest.mark.firefox
def test_incomplete_image_is_hatched_and_measured_only_where_it_was_received(served):
    # The last quarter of the image is missing.
    served.state.store_image(image_record("00A7", missing_rows=10))
    visit = served.visit()
    visit.expect_errors("willReadFrequently")
    visit.wait_for_contact("00A7")
    assert visit.pixels() > 1000
    strip = visit.text(".strip")
    for words in ("150 of 200", "image area missing 25"):
        assert words in strip
    assert "emb" in visit.page.locator(".image-data").text_content()
    assert visit.page.evaluate(HATCH_PIXELS) > 500
    visit.press("m", "m", "m")
    visit.wait(".size.active[data-kind=shadow]")
    visit.press("Enter", *["Shift+ArrowRight"] * 3, "Enter")
    visit.wait(".hint >> text=Enter keeps it")
    visit.press("Enter")
    visit.wait('details[data-name="measurements"] >> text=/shadow 0.75/')
    [stored] = served.contact()["measurements"]
    assert stored["value_m"] == pytest.approx(0.75)
    assert stored["height_m"] == pytest.approx(0.75 * 5.0 / (13.0 + 0.75), rel=0.02)
    assert f"height {stored['height_m']:.2f} ± {stored['height_sigma_m']:.2f}" in visit.text(
        'details[data-name="measurements"]'
    )
    # A line across missing pixels is rejected.
    visit.expect_errors("409")
    visit.press("m", "Enter", *["Shift+ArrowDown"] * 3, "Enter")
    visit.wait("#toasts .bad")
    visit.press("Escape")
    assert len(served.contact()["measurements"]) == 1


@pytest.mark.firefox
def test_displayed_image_is_updated_by_new_versions(served):
    served.state.store_image(image_record("00A7", 1, missing_rows=20))
    visit = served.visit()
    visit.wait_for_contact("00A7")
    assert "50" in visit.text(row("00A7"))
    served.state.store_image(image_record("00A7", 2))
    visit.until("() => document.querySelector('canvas').dataset.shows.endsWith(' 2 raw')")
    visit.wait(f"{row('00A7')} >> text=sent 200")
    # A chosen older version stays displayed.
    visit.page.locator('.versions [data-version="1"]').click()
    visit.until("() => document.querySelector('canvas').dataset.shows.endsWith(' 1 raw')")
    served.state.store_image(image_record("00A7", 3))
    visit.wait('.versions [data-version="3"] .newer')
    assert visit.page.evaluate("document.querySelector('canvas').dataset.shows").endswith(" 1 raw")
    # The image does not change during a measurement.
    visit.page.locator('.versions [data-version="3"]').click()
    visit.until("() => document.querySelector('canvas').dataset.shows.endsWith(' 3 raw')")
    visit.press("m", "Enter")
    served.state.store_image(image_record("00A7", 4))
    visit.wait('.versions [data-version="4"] .newer')
    assert visit.page.evaluate("document.querySelector('canvas').dataset.shows").endswith(" 3 raw")
    visit.press("s")
    visit.until("() => !document.querySelectorAll('canvas')[1].classList.contains('hidden')")


@pytest.mark.firefox
def test_lost_connection_recovers(served):
    add_contacts(served, 2)
    now = served.state.clock()
    served.state.router = RouterState(
        platform_id="vessel-1", reached=True, changed_utc_s=now, listening_since_utc_s=now
    )
    visit = served.visit()
    visit.expect_errors("Failed to load resource", "ERR_", "500", "net::")
    visit.wait_for_contact("0001")
    served.stop()
    visit.wait("#offline")
    assert "No connection to the console's server since" in visit.text("#offline")
    assert "old" in visit.text("#offline")
    visit.wait('#chain [data-place="server"][data-state="lost"]')
    visit.wait('#chain [data-place="router"][data-state="unknown"]')
    # Contacts that arrive in between are displayed afterwards.
    served.state.store_image(image_record("00ZZ", seed=99))
    served.restart()
    visit.wait(row("00ZZ"))
    visit.until("() => !document.getElementById('offline')")
    served.state.store_image(image_record("00ZY", seed=98))
    visit.wait(row("00ZY"))
    visit.wait('#chain [data-place="server"][data-state="ok"]')


@pytest.mark.parametrize("path", ["notices", "contacts?*", "settings"])
def test_response_that_is_cut_is_reported_as_a_lost_one(served, path):
    """A reload of the page cuts the responses to the earlier page, too."""
    add_contacts(served, 1)
    visit = served.visit()
    visit.wait_for_contact("0000")
    visit.page.route(f"**/api/{path}", lambda route: route.fulfill(content_type="application/json", body='{"no'))
    visit.page.reload()
    visit.wait("text=No response from the console's server.")


HOSTILE = '<img src=x onerror="window.injected=1"><script>window.injected=2</script>'


@pytest.mark.firefox
def test_hostile_text_is_displayed_as_text(served):
    served.state.store_image(image_record("00A7", atd_class=HOSTILE[:60], line_name=HOSTILE, sonar_id=HOSTILE))
    visit = served.visit()
    visit.wait_for_contact("00A7")
    visit.press("w")
    visit.page.keyboard.type(HOSTILE)
    visit.press("Escape")
    visit.decide("1")
    visit.page.locator(".now summary").click()
    visit.wait(".now .remark")
    assert HOSTILE in visit.text(".now .remark")
    # Another operator opens all views that show the text.
    other = served.visit("bo")
    other.page.select_option("#review", "all")
    other.wait_for_contact("00A7")
    for summary in other.page.locator("summary").all():
        summary.click()
    other.press("p")
    other.until(MAP_DRAWN)
    other.press("j")
    other.wait(".map .card")
    other.press("f", "q")
    for page in (visit.page, other.page):
        assert page.evaluate("window.injected") is None
        assert page.locator("main img[src='x'], main script").count() == 0
    report = served.visit("bo", path=f"report/{contact_ids(served.state)['00A7']}")
    assert HOSTILE in report.page.inner_text("body")
    assert report.page.evaluate("window.injected") is None


def test_class_probabilities_and_despeckling_are_shown_where_they_are_known(served):
    fields = {"atd_class": "structure", "p_mine_like": 0.83, "p_other_object": 0.12}
    for image_id, strength, known in (("00A8", 0.0, {}), ("00A7", 1.0, fields)):
        # Equal records with and without despeckling are one contact and its layer.
        record = image_record(image_id, time_utc_s=FIRST_UTC_S + strength, **known)
        served.state.store_image(record.model_copy(update={"despeckle_strength": strength}))
    visit = served.visit()
    visit.wait_for_contact("00A7")
    assert visit.text(f"{row('00A7')} .class.structure") == "structure"
    assert visit.page.locator(f"{row('00A8')} .second").inner_text().startswith("Det. 1.20")
    expected = "mine-like 83\u202f%, other object 12\u202f%, seabed 5\u202f%"
    assert "mine-like 83\u202f%" in visit.text(".strip")
    visit.page.locator("details[data-name=record] > summary").click()
    assert expected in visit.text("details[data-name=record]")
    assert "despeckled" in visit.text(".strip")
    assert "strength 1.00" in visit.page.locator(".image-data").text_content()
    visit.press("r")
    visit.wait("[data-request]:focus")
    assert "Without despeckling" in visit.text("[data-request=original]")
    visit.page.locator("[data-request=original]").click()
    visit.page.locator("dialog [data-action=send]").click()
    visit.wait('details[data-name="requests"] >> text=Without despeckling')
    [item] = served.state.unsent_records()
    assert (item.record.kind, item.record.image_id) == ("original", "00A7")
    visit.page.locator(row("00A8")).click()
    visit.wait_for_contact("00A8")
    assert "not despeckled" in visit.text(".strip")
    assert "mine-like" not in visit.text(".strip")
    assert visit.page.locator(f"{row('00A8')} .class").count() == 0
    assert "mine-like" not in visit.text("details[data-name=record]")


def test_observer_cannot_decide_or_measure(served):
    add_contacts(served, 1)
    visit = served.visit("watch")
    visit.wait_for_contact("0000")
    visit.decide("1")
    visit.wait("#toasts >> text=Observers cannot decide")
    assert visit.page.locator(".verdicts .mine_like").is_disabled()
    visit.press("m")
    visit.wait("#toasts >> text=Measurement is locked")
    assert served.decisions("0000") == []


def test_keys_of_the_documentation_are_listed(served):
    add_contacts(served, 1)
    visit = served.visit()
    visit.wait_for_contact("0000")
    visit.open_dialog("?")
    text = (REPOSITORY / "docs" / "explanation" / "console.md").read_text("utf-8")
    [sentence] = re.findall(r"`\?` lists the keys\.(.*?)\n\n", text, re.DOTALL)
    named = set(re.findall(r"`([^`]+)`", sentence))
    keys = set(visit.page.locator("dialog .keys kbd").all_inner_texts())
    assert 20 < len(keys) <= 30
    assert len(named) > 3
    assert named <= keys


@pytest.mark.firefox
def test_list_of_thousands_of_contacts(served):
    with served.state.database.transaction() as db:
        for number in range(1000):
            record = image_record(f"{number:04d}", seed=number % 7, position=None, atd_confidence=number / 500)
            contacts.store_image(db, record, None, 1_700_000_000.0 + number, 8.0)
    visit = served.visit()
    visit.wait_for_contact("0999")
    assert visit.text("#to-do") == "1,000 to do"
    # Only visible rows have elements.
    assert visit.page.locator(".row").count() < 40
    assert visit.page.locator(".row").first.get_attribute("aria-setsize") == "1000"
    visit.page.evaluate("document.getElementById('queue').scrollTop = 1e9")
    visit.wait(row("0000"))
    assert visit.page.locator(".row").count() < 40
    visit.press("/")
    visit.page.keyboard.type("0321")
    visit.wait(".filters .sum >> text=1 of 1,000 found")
    visit.page.click(row("0321"))
    visit.wait_for_contact("0321")
    visit.press("/", "Escape")
    visit.wait(".filters .sum >> text=1,000 of 1,000 shown")
    visit.wait(row("0321") + "[aria-selected=true]")
    assert visit.page.locator(row("0321")).bounding_box()["y"] < 768
    # Scrolling while rows are reloaded is kept.
    visit.page.evaluate("document.getElementById('queue').scrollTop = 0")
    held = []
    visit.page.route("**/api/contacts?*", lambda route: route.continue_() if held is None else held.append(route))
    with visit.page.expect_request("**/api/contacts?*"):
        served.client("bo").decide(contact_ids(served.state)["0500"], verdict="unsure")
    visit.page.evaluate("document.getElementById('queue').scrollTop = 1e9")
    waiting, held = held, None
    for route in waiting:
        route.continue_()
    visit.wait(".filters .sum >> text=999 of 1,000 shown")
    assert visit.page.evaluate("document.getElementById('queue').scrollTop") > 10_000
    visit.wait(row("0000"))
    visit.page.evaluate("document.getElementById('queue').scrollTop = 0")
    visit.page.click(row("0998"))
    visit.wait_for_contact("0998")
    # The grid shows many images at once; opening one leaves it, and no key decides in it.
    visit.page.click(".grid-button")
    visit.page.locator(".contact").wait_for(state="hidden")
    visit.until("() => document.querySelectorAll('.row').length > 20")
    visit.press("1", "ArrowRight", "Enter")
    visit.wait_for_contact("0997")
    assert visit.page.locator(".contact").is_visible()
    assert served.state.counts().to_do == 999


@pytest.mark.firefox
def test_search_is_over_all_contacts_and_ends_with_its_text(served):
    add_contacts(served, 3)
    served.client("bo").decide(contact_ids(served.state)["0001"], verdict="not_mine_like")
    visit = served.visit()
    visit.wait(".filters .sum >> text=2 of 3 shown")
    visit.press("/")
    visit.page.keyboard.type("0001")
    visit.wait(".filters .sum >> text=1 of 3 found")
    visit.wait(f"{row('0001')}[data-review=not_mine_like]")
    assert visit.page.locator(".row").count() == 1
    visit.press("Escape")
    visit.wait(".filters .sum >> text=2 of 3 shown")
    assert visit.page.input_value("#search") == ""
    visit.page.fill("#search", "nothing of this name")
    visit.page.click(".empty button")
    visit.wait(".filters .sum >> text=3 of 3 shown")
    assert visit.page.input_value("#search") == ""


@pytest.mark.firefox
def test_rows_marks_and_counts_follow_each_change(served):
    add_contacts(served, 3)
    ids, state, anna = contact_ids(served.state), served.state, served.client("anna")
    visit = served.visit()
    visit.wait_for_contact("0002")
    visit.page.evaluate(
        """() => {
          window.wrong = [];
          const decided = '.row:not([data-review=unreviewed])';
          const look = () => document.querySelectorAll(decided).forEach(e => wrong.push(e.id));
          new MutationObserver(look).observe(document.getElementById('queue'), { subtree: true, childList: true });
        }"""
    )
    decisions = [
        anna.decide(ids[name], verdict="unsure").json()["decision"]["decision_id"] for name in ("0000", "0001")
    ]
    visit.wait("#undelivered >> text=2 not delivered")
    visit.page.locator(row("0001")).wait_for(state="detached")
    assert visit.page.evaluate("window.wrong") == [], "no row of the list to do is shown with a verdict"
    visit.page.click("#undelivered")
    visit.wait(f"{row('0000')}[data-review=unsure]")
    visit.page.select_option("#review", "all")
    visit.wait(f"{row('0002')}[data-review=unreviewed]")
    for decision in decisions:
        for consumer in ("relay", "op_modem"):
            state.apply_acknowledgement("decision", decision, consumer, None)
    state.mark_delivered_to_shore(state.clock() + 1.0)
    for decision, step in zip(decisions, ("confirmed", "expired"), strict=True):
        state.apply_downlink_state(downlink_state("decision", decision, step, state.clock()))
    visit.wait(f"{row('0000')} .mark.good >> text=✓")
    visit.wait(f"{row('0001')} .mark.bad >> text=!")
    visit.wait("#undelivered.bad >> text=1 not delivered, 1 refused")
    # Contacts since the log-in, and up to a time.
    visit.page.select_option("#review", "watch")
    visit.wait(".filters .sum >> text=0 of 3 shown")
    state.store_image(image_record("0009", first_utc_s=state.clock() + 1.0, position=(57.0, -5.0)))
    visit.wait(".filters .sum >> text=1 of 4 shown")
    visit.page.select_option("#review", "all")
    visit.page.click(".filter-button")
    visit.page.fill("#to", "2023-11-14T22:14")
    visit.page.dispatch_event("#to", "change")
    visit.wait(".filters .sum >> text=3 of 4 shown")


def test_archive_without_anything_to_do_opens_on_all_contacts(serve):
    archive = serve(role="shore")
    for image_id in ("AAAA", "BBBB"):
        archive.state.store_image(image_record(image_id))
        archive.state.store_decision(decision_record(f"d-{image_id}", image_id=image_id))
    visit = archive.visit("watch")
    visit.wait_for_contact("BBBB")
    visit.wait(".filters .sum >> text=2, all reviewed")
    # The filter of the browser is still "to do": a new contact is in it after a reload.
    archive.state.store_image(image_record("CCCC"))
    visit.page.goto("about:blank")
    visit.load(archive.address)
    visit.wait_for_contact("CCCC")
    visit.wait(".filters .sum >> text=1 of 3 shown")


def test_expert_at_the_shore_site_writes_a_comment(serve):
    shore = serve(role="shore")
    add_contacts(shore, 1)
    expert = shore.visit("eva")
    expert.wait_for_contact("0000")
    assert "comment" in expert.text("legend").lower()
    expert.press("w")
    expert.page.keyboard.type("have a second look")
    expert.press("Escape")
    expert.decide("1")
    eventually(lambda: len(shore.contact("0000")["comments"]) == 1, what="the comment")
    expert.wait(".comment >> text=have a second look")
