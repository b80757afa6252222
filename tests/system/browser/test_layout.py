"""The page at all sizes: nothing cut off, film strip, drawer, menus, swipe, and axe-core."""

from importlib.util import find_spec
from pathlib import Path

import pytest
from builders.console import PASSWORD, image_record
from builders.layout_faults import FAULTS

pytestmark = pytest.mark.parametrize("browser", ["chromium"], indirect=True)

# The last one is 1366x768 at 200 %.
SIZES = ((1920, 1080), (1366, 768), (1024, 768), (768, 1024), (390, 844), (683, 384))
# The last one is 1280x1024 at 400 %.
REFLOW = ((320, 568), (320, 256))
THEMES = ("day", "night")

COVERED = """() => [...(document.querySelector('dialog[open], .panel.open, .menu.open, .tools.open') ?? document)
  .querySelectorAll('button, a.button, select, input')].filter(element => {
  if (!element.checkVisibility({ visibilityProperty: true }) || element.closest('.skip')) return false;
  const box = element.getBoundingClientRect();
  const [x, y] = [box.left + box.width / 2, box.top + box.height / 2];
  if (x < 0 || y < 0 || x > innerWidth || y > innerHeight) return false;
  for (let e = element.parentElement; e; e = e.parentElement) {
    const clip = e.getBoundingClientRect();
    const outside = x < clip.left || x > clip.right || y < clip.top || y > clip.bottom;
    if (outside && getComputedStyle(e).overflow !== 'visible') return false;
  }
  const top = document.elementFromPoint(x, y);
  return !(element.contains(top) || top?.contains(element));
}).map(element => element.outerHTML.slice(0, 100))"""


CANVAS_WITHOUT_NAME = """() => [...document.querySelectorAll('canvas:not([aria-label])')]
  .filter(element => element.checkVisibility() && !element.closest('[aria-hidden=true]'))
  .map(element => element.outerHTML.slice(0, 100))"""


def visit_at(served, size=(1366, 768), theme="day", **more):
    for number in range(6):
        record = image_record(f"000{number}", seed=10 * number, atd_confidence=0.3 * number, missing_rows=10)
        served.state.store_image(record)
    served.state.store_image(image_record("0005", version=2, seed=1))
    viewport = {"width": size[0], "height": size[1]}
    visit = served.visit(viewport=viewport, color_scheme="dark" if theme == "night" else "light", **more)
    visit.wait_for_contact("0005")
    return visit


def check_layout(visit):
    visit.settle()
    # At 400 % the page itself scrolls, and the open drawer on it.
    assert [fault for fault in visit.page.evaluate(FAULTS) if not fault.endswith("div.panel.open")] == []
    assert visit.page.evaluate(COVERED) == []


@pytest.mark.parametrize("theme", THEMES)
def test_page_fits_in_both_themes(served, theme):
    visit = visit_at(served, theme=theme)
    colour = "getComputedStyle(document.querySelector('.stage')).backgroundColor"
    for size in SIZES:
        visit.resize(*size)
        check_layout(visit)
        assert visit.page.evaluate(colour) == "rgb(10, 13, 16)"
        # Large type selects another layout.
        visit.set_appearance(size="large")
        check_layout(visit)
        visit.set_appearance(size="normal")


def test_all_views_fit(served):
    visit = visit_at(served)
    for size in (*SIZES, *REFLOW):
        visit.resize(*size)
        for key in ("p", "f", "q"):
            visit.press(key)
            check_layout(visit)
        for name in ("?", "settings", "exports"):
            visit.open_dialog(name)
            check_layout(visit)
            assert visit.page.locator("dialog").bounding_box()["width"] <= size[0]
            visit.press("Escape")
            visit.page.locator("dialog").wait_for(state="detached")


def test_text_of_twice_the_size_is_not_cut_off(served):
    visit = visit_at(served)
    visit.page.evaluate("document.documentElement.style.setProperty('--type', '34px')")
    check_layout(visit)
    assert visit.page.locator(".verdicts button").count() == 3
    visit.decide("2")
    visit.wait('.verdicts [data-verdict="not_mine_like"]')


@pytest.mark.parametrize("size", [(1024, 768), (390, 844), (683, 384), (320, 256)])
def test_every_part_is_reached_with_the_keyboard(served, size):
    visit = visit_at(served, size)
    page = visit.page
    # The drawer opens for the field of a key, and closes with Escape.
    visit.press("w")
    assert page.evaluate("document.activeElement.id") == "remark"
    check_layout(visit)
    visit.press("Escape")
    page.locator("#remark").wait_for(state="hidden")
    # The filters.
    visit.press("/")
    assert page.evaluate("document.activeElement.id") == "search"
    page.keyboard.type("0003")
    visit.wait_for_contact("0005")
    visit.until("() => document.querySelector('.filters .sum').textContent.startsWith('1 of')")
    visit.press("Escape")
    page.locator("#search").wait_for(state="hidden")
    # All tools.
    page.focus("[data-tool=more]")
    visit.press("Enter")
    page.locator("[data-tool=loupe]").wait_for(state="visible")
    check_layout(visit)
    assert page.evaluate("document.activeElement.dataset.tool") == "more"
    visit.press("Enter")
    # The menu of the header.
    for button, inside in (("#menu", '[data-item="log_out"]'),):
        if not page.locator(button).is_visible():
            continue
        page.focus(button)
        visit.press("Enter")
        page.locator(inside).wait_for(state="visible")
        check_layout(visit)
        reached = []
        for _ in range(60):
            visit.press("Tab")
            reached.append(page.evaluate("inside => document.activeElement?.matches(inside)", inside))
            if reached[-1]:
                break
        assert reached[-1]
        visit.press("Escape")
        page.locator(inside).wait_for(state="hidden")
        assert page.evaluate("button => document.activeElement.matches(button)", button)


def test_film_strip_is_virtual_and_moves_with_the_arrows(served):
    for number in range(80):
        served.state.store_image(image_record(f"{number:04d}", seed=1))
    visit = served.visit(viewport={"width": 1024, "height": 768})
    visit.wait_for_contact("0079")
    assert visit.page.locator("#queue").get_attribute("aria-orientation") == "horizontal"
    assert visit.page.locator(".row").count() < 40
    visit.page.focus("#queue")
    visit.press("ArrowRight")
    visit.wait_for_contact("0078")
    visit.press("ArrowLeft")
    visit.wait_for_contact("0079")
    rows = visit.page.locator("#queue").bounding_box()
    # The strip scrolls to the displayed contact, also when a wider window turns it into a list.
    for number in range(78, 68, -1):
        visit.press("j")
        visit.wait_for_contact(f"{number:04d}")
    box = visit.page.locator('.row[aria-selected="true"]').bounding_box()
    assert rows["x"] <= box["x"] <= rows["x"] + rows["width"] - box["width"] + 1
    visit.resize(1366, 768)
    visit.until("() => document.querySelector('#queue').ariaOrientation === 'vertical'")
    rows = visit.page.locator("#queue").bounding_box()
    box = visit.page.locator('.row[aria-selected="true"]').bounding_box()
    assert rows["y"] <= box["y"] <= rows["y"] + rows["height"] - box["height"] + 1


SWIPE = """([from, to]) => {
  const canvas = document.querySelector('.stage canvas');
  const box = canvas.getBoundingClientRect();
  canvas.setPointerCapture = () => {}; // these pointers are not of the browser
  const send = (type, across) => canvas.dispatchEvent(new PointerEvent(type, {
    bubbles: true, pointerId: 7, pointerType: 'touch', isPrimary: true,
    clientX: box.left + across * box.width, clientY: box.top + box.height / 2,
  }));
  send('pointerdown', from); send('pointermove', (from + to) / 2); send('pointerup', to);
}"""


def test_swipe_displays_the_next_and_the_previous_contact(served):
    visit = visit_at(served, (390, 844), has_touch=True)
    swipe = lambda *path: visit.page.evaluate(SWIPE, path)  # noqa: E731
    swipe(0.8, 0.2)
    visit.wait_for_contact("0004")
    swipe(0.2, 0.8)
    visit.wait_for_contact("0005")
    swipe(0.5, 0.45)  # too short
    # No swipe in an enlarged image, and during a measurement.
    visit.press("+")
    swipe(0.8, 0.2)
    visit.press("0", "m")
    swipe(0.8, 0.2)
    visit.press("Escape", "Escape")
    visit.settle()
    assert visit.text(".heading h2").endswith("0005")
    swipe(0.8, 0.2)
    visit.wait_for_contact("0004")


class Axe:
    """Runs axe-core on a page, and collects what it finds."""

    def __init__(self, visit):
        self.visit = visit
        self.found = {}
        module = find_spec("axe_playwright_python")
        assert module is not None, "axe-core is missing: make setup"
        self.script = (Path(module.origin).parent / "axe.min.js").read_text(encoding="utf-8")

    def run(self, *name):
        page = self.visit.page
        if page.evaluate("typeof axe === 'undefined'"):
            page.evaluate(self.script)
        result = page.evaluate("() => axe.run(document, { resultTypes: ['violations'] })")
        assert len(result["passes"]) > 5
        for one in result["violations"]:
            self.found[(*name, one["id"])] = [node["html"][:120] for node in one["nodes"]]
        if unnamed := page.evaluate(CANVAS_WITHOUT_NAME):
            self.found[(*name, "canvas")] = unnamed


# Colours depend on the theme, names and roles on the size.
@pytest.mark.parametrize(
    ("theme", "sizes"), [("day", (*SIZES, REFLOW[0])), ("night", ((1366, 768), (1024, 768), (390, 844)))]
)
def test_axe_finds_no_violation(served, theme, sizes):
    visit = visit_at(served, theme=theme)
    page, axe = visit.page, Axe(visit)
    assert page.evaluate("document.documentElement.dataset.theme") == theme
    for size in sizes:
        visit.resize(*size)
        axe.run(size, "review")
        for button in (".filter-button", "[data-tool=more]", "#menu", ".drawer-button"):
            if page.locator(button).is_visible():
                page.click(button)
                axe.run(size, button)
                visit.press("Escape")
        for name in ("?", "settings", "exports"):
            visit.open_dialog(name)
            axe.run(size, name)
            visit.press("Escape")
        for key in ("p", "f"):
            visit.press(key)
            visit.settle()
            axe.run(size, key)
        visit.press("q")
    # After a decision: a request to confirm, a contact on the map, and a password with an error.
    visit.resize(*sizes[0])
    visit.decide("2")
    visit.wait("#result >> text=not mine-like")
    page.select_option("#review", "all")
    visit.press("r")
    visit.wait("[data-request]:focus")
    axe.run("request")
    visit.press("Escape")
    visit.press("p")
    visit.until("() => document.querySelector('.map').dataset.drawn !== undefined")
    visit.press("j")
    visit.wait(".map .card")
    axe.run("card")
    page.click("#menu")
    page.click('.menu [data-item="password"]')
    page.fill("#password-old", PASSWORD)
    visit.press("Enter")
    visit.wait("#password-problem:has-text('this one has 0')")
    axe.run("password")
    visit.press("Escape")
    visit.press("q")
    contact_id = page.evaluate("decodeURIComponent(location.hash.slice(1))")
    for path in (f"report/{contact_id}", "login"):
        page.goto(served.address + path)
        page.wait_for_load_state("networkidle")
        for size in sizes:
            visit.resize(*size)
            axe.run(size, path)
    assert axe.found == {}
