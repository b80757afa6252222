"""Answers that are lost, late or out of order: the page repeats the request, or discards the answer."""

import pytest
from builders.common import eventually
from builders.console import contact_ids, image_record

from sonarpost.review.positions import destination


def add_contacts(served, count, first=0):
    for number in range(first, first + count):
        served.state.store_image(image_record(f"{number:04d}", seed=10 * number, position=None))


def look(number, vehicle, heading_deg, position, version=1):
    sizes = {"pixel_along_m": 0.1, "pixel_across_m": 0.1}
    place = {"position": position, "heading_deg": heading_deg, "channel": "port"}
    return image_record(f"{number:04d}", version, vehicle=vehicle, seed=number + version, **sizes, **place)


def row(image_id):
    return f'.row[data-id*=".{image_id}"]'


def open_page(served, image_id):
    visit = served.visit(path=f"#{contact_ids(served.state)[image_id]}")
    visit.expect_errors("Failed to load resource", "net::")
    visit.wait_for_contact(image_id)
    return visit


def emit(visit, name, **detail):
    """Send a message within the page."""
    script = "async all => (await import('/static/js/base/state.js')).emit(...all)"
    visit.page.evaluate(script, [name, detail])


class Held:
    """Requests of a page whose answers a test gives."""

    def __init__(self, visit, pattern):
        self._visit = visit
        self._routes = []
        visit.page.route(pattern, self._hold)

    def _hold(self, route):
        self._routes.append(route)

    def wait(self, count=1):
        def arrived():
            self._visit.settle()
            return len(self._routes) >= count

        eventually(arrived, what="the request")

    def forward(self, index=0):
        self._routes[index].continue_()

    def answer(self, index=0, json=None, status=200):
        """Answer a request; without `json`, with the present state of the server."""
        route = self._routes[index]
        with self._visit.page.expect_event("requestfinished", lambda request: request == route.request):
            if json is None:
                self.forward(index)
            else:
                route.fulfill(json=json, status=status)
        self._visit.settle()


def lose_once(visit, pattern):
    visit.page.route(pattern, lambda route: route.abort(), times=1)


@pytest.mark.parametrize("path", ["settings", "fleet", "decisions/last", "contacts?*"])
def test_start_repeats_a_lost_answer_and_receives_events(served, path):
    add_contacts(served, 1)
    visit = open_page(served, "0000")
    lose_once(visit, f"**/api/{path}")
    visit.page.reload()
    visit.wait("#toasts .bad")
    visit.wait(row("0000"))
    assert visit.page.locator(".no-contacts:not(.hidden)").count() == 0
    add_contacts(served, 1, first=1)
    visit.wait(row("0001"))


def test_updates_repeat_a_lost_answer(served):
    add_contacts(served, 120)
    visit = open_page(served, "0119")
    # Of an image.
    lose_once(visit, "**/versions/2/image.png")
    served.state.store_image(image_record("0119", 2, seed=7))
    visit.wait("#toasts .bad >> text=No response from the console's server.")
    visit.until("() => document.querySelector('canvas').dataset.shows.endsWith(' 2 raw')")
    # Of the rows to which the operator scrolls.
    lose_once(visit, "**/api/contacts?*offset=50*")
    visit.page.evaluate("document.querySelector('#queue .row:last-child').scrollIntoView()")
    visit.page.evaluate("document.getElementById('queue').scrollTop = 1e6")
    visit.wait(row("0000"))
    # Of the map.
    lose_once(visit, "**/api/map")
    visit.press("p")
    visit.wait(".map[data-drawn]")


def test_changes_while_the_page_loads_are_displayed(served):
    add_contacts(served, 1)
    visit = open_page(served, "0000")
    stream = Held(visit, "**/events*")
    visit.page.reload()
    stream.wait()
    visit.wait(row("0000"))
    add_contacts(served, 1, first=1)
    stream.forward()
    visit.wait(row("0001"))


def test_earlier_answers_do_not_replace_later_ones(served):
    add_contacts(served, 2)
    visit = open_page(served, "0001")
    # The state of a contact, after another one is displayed.
    state = Held(visit, f"**/api/contacts/{contact_ids(served.state)['0001']}")
    emit(visit, "reload")
    state.wait()
    visit.press("j")
    visit.wait_for_contact("0000")
    state.answer(json={"error": {"code": "not_found", "message": "gone"}}, status=404)
    visit.decide("2")
    eventually(lambda: len(served.decisions("0000")) == 1, what="the decision")
    # Notices.
    notices = Held(visit, "**/api/notices")
    for count in (1, 2):
        emit(visit, "notice", user="anna")
        notices.wait(count)
    notice = {"id": 1, "contact_id": "c", "name": "uuv-1/0001", "kind": "differs", "own_verdict": "unsure"}
    notices.answer(1, json={"notices": [notice]})
    visit.wait("#notices:not(.hidden)")
    notices.answer(0, json={"notices": []})
    assert visit.page.locator("#notices:not(.hidden)").count() == 1
    # A contact that is gone receives no verdict.
    gone = Held(visit, f"**/api/contacts/{contact_ids(served.state)['0000']}")
    emit(visit, "contact", contact={"id": contact_ids(served.state)["0000"]})
    gone.wait()
    gone.answer(json={"error": {"code": "not_found", "message": "gone"}}, status=404)
    visit.wait(".decision[data-ready=false]", state="attached")


def test_tools_end_with_the_image_on_which_they_began(served):
    """A region, a measurement and the object panel."""
    add_contacts(served, 1)
    for number, (vehicle, heading_deg) in enumerate((("uuv-1", 0.0), ("uuv-2", 90.0)), 1):
        place = destination(56.0, -5.0, 0.0, number)
        served.state.store_image(look(number, vehicle, heading_deg, place))
    visit = open_page(served, "0001")
    emit(visit, "region")
    visit.wait(".region-layer")
    visit.press("k")
    visit.until("() => !document.querySelector('.region-layer')")
    visit.press("j")
    visit.wait_for_contact("0001")
    # The result of a length, after the width was chosen.
    result = Held(visit, "**/measure")
    visit.press("m", "Enter", "ArrowDown", "Enter")
    result.wait()
    visit.press("m")
    line = {"from": [1, 1], "to": [9, 1], "snapped": [True, True], "metres": "ground"}
    result.answer(json={"kind": "length", "value_m": 1.0, "sigma_m": 0.1, **line})
    assert visit.page.locator(".hint >> text=Enter keeps it").count() == 0
    visit.press("Escape")
    # The object of the contact before.
    panel = Held(visit, "**/api/objects/*")
    visit.page.click(".open-object")
    panel.wait()
    visit.press("j")
    visit.wait_for_contact("0000")
    panel.answer()
    assert visit.page.locator("dialog").count() == 0
    # The panel, while the new version of a look is loaded.
    visit.press("k")
    visit.wait_for_contact("0001")
    visit.page.click(".open-object")
    panel.wait(2)
    panel.answer(1)
    drawn = "dialog.object canvas[data-shows]"
    visit.until(f"() => document.querySelectorAll('{drawn}').length === 2")
    image = Held(visit, "**/versions/2/image.png")
    served.state.store_image(look(2, "uuv-2", 90.0, destination(56.0, -5.0, 0.0, 2), version=2))
    panel.wait(3)
    panel.answer(2)
    image.wait()
    assert visit.page.locator(drawn).count() == 1
    assert "1 look" in visit.text(".object-decision")
