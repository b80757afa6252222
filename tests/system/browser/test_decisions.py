"""Decisions on the page: change of contact, one-key verdicts, undo, disputes, drafts."""

import pytest
from builders.common import eventually
from builders.console import contact_ids, image_record, session_cookie

VERDICTS = ("mine_like", "not_mine_like", "unsure")
LATENCY_S = 0.4
COUNT = 20

# Records the image on the canvas at each decision, and differences between row, heading, form and image in any frame.
OBSERVE = """() => {
  window.decided = [];
  window.gaps = [];
  window.shown = [];
  const real = window.fetch;
  const drawn = () => document.querySelector('.stage canvas').dataset.shows?.split(' ')[0];
  window.fetch = (path, options) => {
    if (options?.method === 'POST' && path.endsWith('/decisions')) {
      window.decided.push([drawn(), decodeURIComponent(path.split('/')[3]), JSON.parse(options.body)]);
    }
    return real(path, options);
  };
  const sample = () => {
    const id = drawn();
    const image = id?.split('.').at(-1);
    const name = document.querySelector('.heading h2')?.textContent;
    const row = document.querySelector('.row[aria-selected=true]')?.dataset.id;
    const link = decodeURIComponent(location.hash.slice(1));
    const form = document.getElementById('remark').value;
    if (id && window.shown.at(-1) !== id) window.shown.push(id);
    const agree = [
      name?.endsWith('/' + image), row === id || row === undefined, link === id, form === '' || form.endsWith(image),
    ];
    if (id && !agree.every(Boolean)) window.gaps.push([id, name, row, link, form]);
    requestAnimationFrame(sample);
  };
  requestAnimationFrame(sample);
}"""

KEY = """([code, key]) =>
  document.body.dispatchEvent(new KeyboardEvent('keydown', { code, key, bubbles: true, cancelable: true }))"""
# Presses a key, then another one in the first frame with the image of another contact.
PRESS_IN_THE_FIRST_FRAME = """([first, image, code, key]) => new Promise(done => {
  const press = (code, key) =>
    document.body.dispatchEvent(new KeyboardEvent('keydown', { code, key, bubbles: true, cancelable: true }));
  const watch = () => {
    const shows = document.querySelector('.stage canvas').dataset.shows;
    if (!shows.includes(`.${image} `)) return requestAnimationFrame(watch);
    press(code, key);
    setTimeout(done, 0);
  };
  press('', first);
  watch();
})"""


def add_contacts(served, count):
    served.state.store_images(
        [image_record(f"{number:04d}", seed=10 * number, position=None) for number in range(count)]
    )


def row(image_id):
    return f'.row[data-id*=".{image_id}"]'


def delay(visit, seconds=LATENCY_S):
    """Add a latency to each response of the server."""
    visit.page.evaluate(
        """ms => {
          const real = window.fetch;
          window.fetch = async (...all) => {
            await new Promise(done => setTimeout(done, ms / 2));
            const response = await real(...all);
            await new Promise(done => setTimeout(done, ms / 2));
            return response;
          };
        }""",
        1000 * seconds,
    )


def open_slow_page(served, count):
    """A page on the first contact of several, by name, with latency and observation."""
    add_contacts(served, count)
    visit = open_page(served)
    # All contacts: decided ones stay in the list.
    visit.page.evaluate(
        "() => { localStorage.setItem('sonarpost.review', ''); localStorage.setItem('sonarpost.sort', 'name asc'); }"
    )
    visit.page.reload()
    visit.until(
        "() => document.querySelector('.row[data-index=\"0\"][aria-selected=true]')?.dataset.id.endsWith('.0000')"
    )
    visit.wait_for_contact("0000")
    visit.page.evaluate("document.getElementById('queue').focus()")
    delay(visit)
    visit.page.evaluate(OBSERVE)
    return visit


def open_page(served, user="anna", image_id="0000"):
    visit = served.visit(user, path=f"#{contact_ids(served.state)[image_id]}")
    visit.wait_for_contact(image_id)
    visit.page.evaluate("document.getElementById('queue').focus()")
    return visit


@pytest.mark.firefox
def test_fast_decisions_go_to_the_contact_whose_image_is_in_sight(served):
    visit = open_slow_page(served, COUNT + 2)
    sent = [VERDICTS[number % 3] for number in range(COUNT)]
    for number, verdict in enumerate(sent):
        visit.decide(str(1 + VERDICTS.index(verdict)))  # as soon as it counts
        # The fourth in two seconds is asked for.
        visit.until("count => window.decided.length > count || document.querySelector('dialog[open]')", number)
        if visit.page.locator("dialog[open]").count():
            visit.press("Enter")
        visit.until("count => window.decided.length > count", number)
        visit.wait_for_contact(f"{number + 1:04d}")
    decided = visit.page.evaluate("window.decided")
    assert [drawn for drawn, _, _ in decided] == [posted for _, posted, _ in decided]
    assert [body["verdict"] for _, _, body in decided] == sent
    assert len({posted for _, posted, _ in decided}) == COUNT
    assert min(body["shown_s"] for _, _, body in decided) >= 0.299  # timers are rounded to 1 ms
    stored = served.state
    eventually(lambda: stored.counts().to_do == 2, what="the decisions")
    for _, contact_id, body in decided:
        detail = stored.contact_detail(contact_id)
        [decision] = detail["decisions"]
        assert (decision["verdict"], decision["sha256"]) == (body["verdict"], detail["versions"][0]["sha256"])
        assert detail["audit"][-1]["detail"]["shown_s"] == body["shown_s"]
    assert visit.page.evaluate("window.gaps") == []


@pytest.mark.firefox
def test_held_early_and_hasty_verdict_keys(served):
    visit = open_slow_page(served, 8)
    keyboard = visit.page.keyboard
    shown = "window.decided.map(([drawn, id, body]) => [drawn.slice(-4), id.slice(-4), body.verdict])"
    # A held key sends one verdict, also while the next contact is in sight.
    visit.wait(".decision[data-ready=true]")
    keyboard.down("2")
    visit.wait_for_contact("0001")
    visit.wait(".decision[data-ready=true]")
    for _ in range(40):
        keyboard.down("2")
    keyboard.up("2")
    assert visit.page.evaluate(shown) == [["0000", "0000", "not_mine_like"]]
    # Keys during a change of contact: j is applied after it; a verdict is neither sent nor queued.
    visit.press("j", "1", "j")
    visit.wait("#toasts >> text=Ignored")
    visit.wait_for_contact("0003")
    assert len(visit.page.evaluate(shown)) == 1
    # A key in one of the first frames of an image is ignored. On an AZERTY keyboard, "1" has the character "&".
    visit.page.evaluate(PRESS_IN_THE_FIRST_FRAME, ["k", "0002", "Digit1", "&"])
    assert len(visit.page.evaluate(shown)) == 1
    visit.wait(".decision[data-ready=true]")
    visit.page.evaluate(KEY, ["Digit1", "&"])
    visit.wait_for_contact("0003")
    assert visit.page.evaluate(shown)[1:] == [["0002", "0002", "mine_like"]]
    # Four within two seconds: the last one is asked for. With a clock that stands still, all are.
    visit.page.evaluate("performance.now = () => 1e6")
    visit.decide("3")
    visit.wait_for_contact("0004")
    visit.page.locator(".decision[data-ready=true] .mine_like").click()
    visit.wait_for_contact("0005")
    visit.decide("1")
    visit.wait_for_contact("0006")
    visit.decide("2")
    visit.wait("dialog >> text=uuv-1/0006")
    visit.press("1", "Escape")
    assert len(visit.page.evaluate(shown)) == 5
    visit.press("2")
    visit.wait("dialog")
    visit.press("Enter")
    visit.wait_for_contact("0007")
    assert visit.page.evaluate(shown)[-1] == ["0006", "0006", "not_mine_like"]
    assert visit.page.evaluate("window.gaps") == []


@pytest.mark.firefox
def test_name_row_form_and_image_change_in_one_frame(served):
    add_contacts(served, 12)
    # Each contact has its own draft, so that the form shows to which contact it belongs.
    drafts = [
        [contact_id, {"remark": f"remark on {image_id}"}] for image_id, contact_id in contact_ids(served.state).items()
    ]
    visit = open_page(served, image_id="0011")
    visit.page.evaluate("drafts => localStorage.setItem('sonarpost.drafts.anna', JSON.stringify(drafts))", drafts)
    visit.page.reload()
    visit.wait_for_contact("0011")
    visit.page.evaluate("document.getElementById('queue').focus()")
    delay(visit)
    visit.page.evaluate(OBSERVE)
    visit.page.locator(row("0004")).click()  # not one of the three contacts that are loaded in advance
    visit.wait(".stage.loading .loading-name >> text=loading")
    # While it is loaded, all of the old contact is displayed.
    assert visit.text(".heading h2").endswith("0011")
    visit.until("() => !document.querySelector('.stage.loading')")
    for number in range(3):
        visit.press("k")
        visit.until("number => window.shown.length >= number", number + 3)
    visit.page.locator(row("0005")).click()
    visit.wait_for_contact("0005")
    assert visit.page.input_value("#remark") == "remark on 0005"
    assert visit.page.evaluate("window.gaps") == []
    assert len(visit.page.evaluate("window.shown")) == 6


def test_each_contact_needs_one_key(served):
    # The fourth verdict within two seconds would be confirmed.
    add_contacts(served, 3)
    visit = served.visit()
    for number in reversed(range(3)):
        visit.wait_for_contact(f"{number:04d}")
        visit.decide("1")
    eventually(lambda: served.state.counts().to_do == 0, what="three decisions")
    visit.wait("#toasts >> text=No other unreviewed contacts")
    assert {served.contact(f"{number:04d}")["contact"]["review"] for number in range(3)} == {"mine_like"}


@pytest.mark.firefox
def test_contact_that_cannot_be_loaded_leaves_the_old_one(served):
    add_contacts(served, 6)
    visit = served.visit()
    visit.expect_errors("Failed to load resource", "ERR_", "net::")
    visit.wait_for_contact("0005")
    served.stop()
    visit.wait("#offline")
    visit.press("j")
    visit.wait("#toasts .bad >> text=uuv-1/0004 could not be loaded")
    assert visit.text(".heading h2").endswith("0005")
    assert visit.page.locator(".row[aria-selected=true]").get_attribute("data-id").endswith(".0005")
    assert visit.page.evaluate("document.querySelector('canvas').dataset.shows").endswith(".0005 1 raw")
    assert visit.page.locator(".stage.loading").count() == 0
    # A verdict on the old contact is not lost: the form keeps it.
    visit.decide("2")
    visit.wait("#result .bad >> text=uuv-1/0005 was not sent")
    served.restart()
    visit.until("() => !document.getElementById('offline')")
    assert served.decisions("0004") == served.decisions("0005") == []
    visit.decide("2")
    visit.wait("#result >> text=uuv-1/0005")
    eventually(lambda: len(served.decisions("0005")) == 1, what="the decision")
    assert served.decisions("0005")[0]["verdict"] == "not_mine_like"


@pytest.mark.firefox
def test_decision_and_undo_from_any_contact(serve):
    served = serve(take_back_s=60)
    add_contacts(served, 4)
    visit = served.visit()
    visit.wait_for_contact("0003")
    visit.decide("2")
    visit.wait("#result >> text=uuv-1/0003 ○ not mine-like")
    assert "take back" in visit.text("#take-back")
    visit.wait_for_contact("0002")
    visit.press("j")
    visit.wait_for_contact("0001")
    visit.press("u")
    visit.wait_for_contact("0003")
    visit.wait("#result >> text=taken back before sending")
    withdrawal, first = served.decisions("0003")
    assert (withdrawal["undoes"], first["undone"]) == (first["decision_id"], True)
    # The audit has the image that the undo displayed.
    entry = served.contact("0003")["audit"][-1]
    assert (entry["action"], entry["version"], entry["sha256"]) == ("undo", 1, first["sha256"])
    assert served.state.unsent_records() == []
    visit.wait(".now >> text=No decision yet")
    visit.press("u")
    visit.wait("#toasts >> text=No decision of yours")


@pytest.mark.firefox
def test_take_back_time_ends_and_survives_a_reload(serve):
    served = serve(take_back_s=15)
    add_contacts(served, 2)
    visit = served.visit()
    visit.expect_errors("No response from the console's server.")  # a request that the reload ends
    visit.wait_for_contact("0001")
    visit.decide("1")
    visit.wait("#take-back >> text=take back")
    visit.page.reload()
    visit.wait("#take-back >> text=take back")
    visit.wait("#take-back >> text=undo")
    eventually(lambda: len(served.state.unsent_records()) == 1, what="the released decision")
    visit.page.locator("#take-back").click()
    visit.wait("#result >> text=undone")
    assert [item.record.verdict for item in served.state.unsent_records()] == ["mine_like", "unsure"]


@pytest.mark.firefox
def test_verdict_key_sends_class_confidence_and_remark(serve):
    served = serve(classes={"MILCO": ["manta"], "NOMBO": ["rock", "debris"]})
    add_contacts(served, 4)
    visit = served.visit()
    visit.wait_for_contact("0003")
    visit.page.select_option("#class-choice", "NOMBO > rock")
    assert visit.page.input_value("#mlo-class") == "NOMBO > rock"
    visit.page.click("[data-confidence='0.9']")
    visit.press("w")
    visit.page.keyboard.type("flat, no shadow")
    visit.press("Escape")
    visit.decide("2")
    visit.wait("#result >> text=uuv-1/0003")
    [decision] = served.decisions("0003")
    found = [decision[name] for name in ("verdict", "mlo_class", "confidence", "remark")]
    assert found == ["not_mine_like", "NOMBO > rock", 0.9, "flat, no shadow"]
    # Enter in the class field sends nothing.
    visit.wait_for_contact("0002")
    visit.page.locator("#mlo-class").fill("tyre")
    visit.page.click("[data-confidence='0.5']")
    visit.page.click("[data-confidence='0.5']")  # not given again
    visit.page.focus("#mlo-class")
    visit.press("Enter", "Escape", "Enter")
    visit.decide("3")
    visit.wait("#result >> text=uuv-1/0002 ? unsure")
    [decision] = served.decisions("0002")
    assert (decision["verdict"], decision["mlo_class"], decision["confidence"]) == ("unsure", "tyre", None)
    # The buttons do the same.
    visit.wait_for_contact("0001")
    visit.page.locator(".decision[data-ready=true] .mine_like").click()
    visit.wait("#result >> text=uuv-1/0001")
    visit.wait_for_contact("0000")
    eventually(lambda: [one["verdict"] for one in served.decisions("0001")] == ["mine_like"])


@pytest.mark.firefox
def test_form_does_not_move(served):
    add_contacts(served, 4)
    served.state.store_image(image_record("0003", 2, seed=1))
    visit = served.visit()
    visit.wait_for_contact("0003")
    boxes = [".verdicts .mine_like", ".verdicts .unsure", "#remark", ".stage", ".heading"]

    # In Firefox the scrollbar of the panel takes 17 px of width when it is shown.
    compared = ["y", "height"] if visit.is_firefox() else ["x", "y", "width", "height"]

    def positions():
        found = [visit.page.locator(one).bounding_box() for one in boxes]
        return [[box[name] for name in compared] for box in found]

    first = positions()
    visit.press("w")
    visit.page.keyboard.type("a remark of some length, so that the state has as many lines as it can have " * 3)
    assert positions() == first
    visit.press("Escape")
    visit.decide("1")
    visit.wait_for_contact("0002")
    visit.wait("#result >> text=uuv-1/0003")
    assert positions()[:4] == first[:4]
    visit.press("u")
    visit.wait_for_contact("0003")
    assert positions() == first
    visit.decide("1")
    visit.wait_for_contact("0002")
    visit.page.select_option("#review", "all")
    visit.page.locator(row("0003")).click()
    visit.wait(".now .badge.mine_like")
    assert positions() == first


@pytest.mark.firefox
def test_differing_verdicts_are_both_kept(served):
    add_contacts(served, 3)
    anna, bo = open_page(served, "anna"), open_page(served, "bo")
    # The second operator does not see the decision of the first one before the key.
    bo.page.route("**/events*", lambda route: route.abort())
    anna.decide("1")
    anna.wait("#result >> text=uuv-1/0000 ▲")
    bo.decide("2")
    bo.press("Enter", "Enter")
    bo.wait("#result >> text=disputed")
    bo.expect_errors("net::", "Failed to load")
    assert [one["verdict"] for one in served.decisions("0000")] == ["not_mine_like", "mine_like"]
    anna.wait("#notices >> text=1 decision of yours")
    # Both see the image beside both verdicts; no button has the focus, and Enter changes nothing.
    for visit in (anna, bo):
        visit.page.goto(served.address + "#" + contact_ids(served.state)["0000"])
        visit.page.reload()
        visit.wait_for_contact("0000")
        visit.wait(".now .badge.disputed")
        # One line for each operator, with the delivery of that verdict.
        visit.wait(".standing li:nth-child(3)")
        mine, other = (visit.page.locator(f".standing li:has(.badge.{one})") for one in ("mine_like", "not_mine_like"))
        assert ("anna" in mine.inner_text(), "bo" in other.inner_text()) == (True, True)
        assert mine.locator("[title^='waiting']").count() > other.locator("[title^='waiting']").count()
        assert other.locator("[title^='not sent: another verdict counts']").count() == 1
        assert mine.locator("[title^='not sent: another verdict counts']").count() == 0
        assert visit.page.locator("dialog").count() == 0
        visit.press("Enter", "Enter")
    assert len(served.decisions("0000")) == 2
    assert served.contact("0000")["contact"]["review"] == "disputed"
    # Settled with a reason.
    button = bo.page.locator("[data-overrule=not_mine_like]")
    assert button.is_disabled()
    bo.page.fill("#overrule-reason", "boulder, seen on the second pass")
    bo.press("Enter")
    assert len(served.decisions("0000")) == 2
    button.click()
    eventually(lambda: len(served.decisions("0000")) == 3, what="the settling decision")
    bo.wait(".now .badge.not_mine_like")
    latest, *earlier = served.decisions("0000")
    assert len(earlier) == 2
    assert (latest["operator"], latest["remark"]) == ("bo", "boulder, seen on the second pass")
    # The overruled operator receives a notice, which stays after a reload, until it is acknowledged.
    anna.page.reload()
    anna.wait("#notices >> text=1 decision of yours")
    anna.page.locator("#notices").click()
    anna.wait("dialog >> text=boulder, seen on the second pass")
    anna.page.locator("dialog [data-acknowledge]").click()
    anna.until("() => !document.querySelector('dialog [data-acknowledge]')")
    anna.press("Escape")
    anna.until("() => document.getElementById('notices').classList.contains('hidden')")


def test_undo_never_takes_back_the_decision_of_another_operator(served):
    add_contacts(served, 2)
    bo = open_page(served, "bo", "0000")
    bo.decide("1")
    bo.wait("#result >> text=uuv-1/0000")
    anna = open_page(served, "anna", "0000")
    anna.wait(".now .badge.mine_like")
    anna.press("u")
    anna.wait("#toasts >> text=No decision of yours")
    assert len(served.decisions("0000")) == 1
    anna.wait(".overrule >> text=Overrule bo")


@pytest.mark.firefox
def test_drafts_survive_reload_and_the_end_of_the_session(served):
    add_contacts(served, 3)
    visit = open_page(served, image_id="0001")
    visit.press("w")
    visit.page.keyboard.type("possible cylinder")
    visit.press("Escape")
    visit.page.click("[data-confidence='0.25']")
    visit.page.reload()
    visit.wait_for_contact("0001")
    assert visit.page.input_value("#remark") == "possible cylinder"
    # The contact of the address is displayed, not the first one of the list.
    assert visit.page.get_attribute('.row[aria-selected="true"]', "data-id").endswith(".0001")
    # Another session of the same user in this browser.
    visit.page.context.clear_cookies()
    token = served.users.start_session("anna").token
    visit.page.context.add_cookies([{"name": session_cookie(served.address), "value": token, "url": served.address}])
    visit.page.reload()
    visit.wait_for_contact("0001")
    visit.wait("#result >> text=Your draft on uuv-1/0001 is back, not sent")
    visit.wait(".decision .stale >> text=Draft, not sent")
    visit.page.evaluate("document.getElementById('queue').focus()")
    visit.decide("1")
    visit.wait("#result >> text=uuv-1/0001 ▲")
    [decision] = served.decisions("0001")
    assert (decision["confidence"], decision["remark"]) == (0.25, "possible cylinder")
    visit.until("() => localStorage.getItem('sonarpost.drafts.anna') === '[]'")
    # The number of drafts is bounded.
    visit.page.evaluate(
        """async () => {
          const { Drafts } = await import('/static/js/decision/drafts.js');
          const drafts = new Drafts('anna');
          for (let i = 0; i < 70; i += 1) drafts.change({ id: `c${i}`, name: `c${i}` }, { remark: 'x' });
        }"""
    )
    stored = visit.page.evaluate("JSON.parse(localStorage.getItem('sonarpost.drafts.anna')).map(([id]) => id)")
    assert stored == [f"c{number}" for number in range(20, 70)]


def test_line_at_the_foot_covers_nothing(served):
    add_contacts(served, 2)
    visit = served.visit()
    visit.wait_for_contact("0001")
    visit.decide("1")
    visit.wait("#result >> text=uuv-1/0001")
    visit.wait_for_contact("0000")
    for theme in ("day", "night"):
        visit.set_appearance(theme=theme)
        for width, height in ((1366, 768), (1920, 1080), (390, 844)):
            visit.resize(width, height)
            foot, main = (visit.page.locator(one).bounding_box() for one in ("#foot", "#main"))
            assert main["y"] + main["height"] <= foot["y"] + 0.5
            assert foot["y"] + foot["height"] <= height + 0.5
            button = visit.page.locator("#take-back").bounding_box()
            assert button["x"] + button["width"] <= width
