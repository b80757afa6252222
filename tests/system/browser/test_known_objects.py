"""Training and calibrated watch in the page: object after the decision, score, comments folded before the decision."""

import re
import time

from builders.console import comment_record, image_record

from sonarpost.services.console.store.truth import Truth


def add(served, image_id, truth, **changes):
    served.state.store_image(image_record(image_id, **changes), truth)


def reveal(served):
    """End the take-back time of all decisions, and reveal objects."""
    now = served.state.clock()
    served.state.clock = lambda: now + 60.0
    served.state.reveal()


def test_object_is_shown_after_the_decision_and_counted_in_the_score(serve):
    served = serve(calibration_share=0.1)
    add(served, "00A7", Truth(is_mine_like=True, label="practice mine", sealed=False))
    add(served, "00A8", Truth(is_mine_like=False, label="boulder", sealed=False), position=(56.01, -5.0))
    visit = served.visit()
    visit.wait_for_contact("00A8")
    before_s = time.monotonic()
    visit.page.click('.row[data-id*=".00A7"]')
    visit.wait_for_contact("00A7")
    shown_s = time.monotonic()
    assert not visit.page.is_visible(".known")
    visit.settle()
    least_s = time.monotonic() - shown_s
    visit.decide("1")
    visit.wait_for_contact("00A8")
    # The page moves on before the decision is stored.
    visit.until("() => document.querySelector('#to-do b').textContent === '1'")
    with served.state.database.read() as db:
        [decided_s] = db.execute("SELECT shown_s FROM decision").fetchone()
    assert least_s <= decided_s <= time.monotonic() - before_s
    visit.decide("1")
    visit.until("() => document.querySelector('#to-do b').textContent === '0'")
    assert "practice mine" not in visit.page.content()
    reveal(served)
    visit.wait("#truth .bad, #truth.bad, #truth.good")
    visit.page.click("#menu")
    visit.page.click('.menu [data-item="score"]')
    visit.wait("dialog .score")
    table = visit.text("dialog")
    assert "practice mine" in table
    assert "boulder" in table
    assert "correct" in table
    assert "wrong" in table
    assert "Pd" in table
    assert "100\u202f% (1 of 1; " in table
    assert "[object" not in table
    visit.page.click("dialog tbody button >> text=00A7")
    visit.wait_for_contact("00A7")
    visit.wait(".known >> text=practice mine")


def test_comments_are_folded_before_the_decision(served):
    add(served, "00A7", None)
    served.state.store_comment(comment_record(verdict="mine_like", mlo_class="manta", remark="seen before, mark 3"))
    visit = served.visit()
    visit.wait_for_contact("00A7")
    folded = '.details [data-name="comments"]'
    visit.wait(folded)
    assert visit.page.get_attribute(folded, "open") is None
    visit.decide("2")
    visit.wait(f"{folded}[open]")
    visit.wait(".comment >> text=seen before, mark 3")
    # Without known objects, the score has the decisions by operator only.
    visit.page.click("#menu")
    visit.page.click('.menu [data-item="score"]')
    visit.wait("dialog .score")
    assert visit.page.locator("dialog table").count() == 1
    assert re.search(r"anna\s+1 not mine-like\s", visit.text("dialog"))
