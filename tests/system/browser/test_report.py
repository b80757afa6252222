"""Report, target sheets and exports in Chromium: one A4 page, true metres, progress, cancel."""

import base64
import io
import os
import re
import sqlite3
import threading
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.console import image_record
from PIL import Image
from playwright.sync_api import Page

from sonarpost.messages import Pixels
from sonarpost.review.rendering import eight_bits
from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.survey_detection import detect_in_survey
from sonarpost.services.console.web.export_routes import ExportRoutes

ID = "sonarpost.vessel-1.uuv-1.20231114T221320Z.00A7"
SIZES = {"pixel_along_m": 0.12, "pixel_across_m": 0.03}


def assert_pages(page: Page, number: int) -> None:
    """Check the number of printed pages; only Chromium prints to PDF without a dialog."""
    browser = page.context.browser
    assert browser is not None
    if browser.browser_type.name == "chromium":
        assert len(re.findall(rb"/Type\s*/Page\b", page.pdf(prefer_css_page_size=True))) == number


def drawn_shape(page: Page, number: int = 0) -> tuple[float, float]:
    """Return height and width of the sonar image as drawn, without the strip of the scale bar."""
    image = page.locator("figure img").nth(number)
    data = base64.b64decode((image.get_attribute("src") or "").partition(",")[2])
    pixels = np.asarray(Image.open(io.BytesIO(data)).convert("L"))
    # The strip begins with a white row.
    rows = int(np.argmax((pixels == 255).all(axis=1)))
    box: Any = image.evaluate("e => [e.height, e.width]")  # without the border
    return box[0] * rows / pixels.shape[0], box[1]


def test_report_is_one_page_in_true_metres(served):
    served.state.store_image(image_record("00A7", missing_rows=5, **SIZES))
    anna = served.client("anna")
    anna.decide(ID)
    report = served.visit("bo", path=f"report/{ID}").page
    assert_pages(report, 1)
    height, width = drawn_shape(report)
    assert height / width == pytest.approx(40 * 0.12 / (60 * 0.03), rel=0.02)
    text = report.inner_text("body")
    for words in (
        "mine-like",
        "56° 00.0000\N{PRIME} N, 5° 00.0000\N{PRIME} W",
        "ground 12.0 m",
        "000.0°, starboard",
        "The compression is lossy",
    ):
        assert words in text, words
    assert "mine_like" not in text
    assert "TRAINING" not in text


def test_target_sheets_have_one_page_for_each_contact(served):
    for number in range(3):
        served.state.store_image(image_record(f"000{number}", first_utc_s=1_700_000_000.0 + number, **SIZES))
    sheets = served.visit("bo", path="report?q=000").page
    assert sheets.locator(".sheet").count() == 3
    assert_pages(sheets, 3)


@pytest.fixture
def held(served, monkeypatch):
    """An export waits after its second contact."""
    for number in range(4):
        served.state.store_image(image_record(f"000{number}", first_utc_s=1_700_000_000.0 + number))
    leave, check = threading.Event(), ExportRoutes._check

    def wait(routes: ExportRoutes, file: Any, progress: Any) -> None:
        while progress.done == 2 and not progress.cancelled and not leave.wait(0.05):
            pass
        check(routes, file, progress)

    monkeypatch.setattr(ExportRoutes, "_check", wait)
    yield leave
    leave.set()


@pytest.mark.chromium_only("Playwright receives no event of a download from Firefox")
def test_export_is_cancelled_and_shows_its_progress(served, held, tmp_path):
    visit = served.visit()
    visit.expect_errors("409")
    visit.open_dialog("exports")
    visit.page.locator("dialog [data-export=kmz]").click()
    visit.wait("dialog .progress >> text=2 of 4 contacts")
    visit.page.locator("dialog .cancel").click()
    visit.wait("dialog .progress >> text=The export was cancelled")
    assert served.client("anna").get("/api/export").json() == {"export": None}
    # Another export starts.
    visit.page.locator("dialog [data-export=kmz]").click()
    visit.wait("dialog .progress >> text=2 of 4 contacts")
    assert visit.page.evaluate("document.querySelector('dialog progress').value") == pytest.approx(0.5)
    with visit.page.expect_download() as download:
        held.set()
    download.value.save_as(tmp_path / "contacts.kmz")
    assert Path(tmp_path / "contacts.kmz").stat().st_size > 1000
    visit.wait("dialog .progress >> text=contacts.kmz is saved")
    assert not visit.page.locator("dialog progress").is_visible()
    # The times of the dialog restrict the exports and the sheets.
    visit.page.locator("dialog input").nth(1).fill("2023-11-14T22:13:22")
    visit.page.locator("dialog input").nth(1).dispatch_event("change")
    visit.wait("dialog >> text=Exports 2 contacts")
    assert "to_utc_s=1700000002" in visit.page.locator("dialog .exports a").last.get_attribute("href")
    with visit.page.expect_download() as download:
        visit.page.locator("dialog [data-export=gpkg]").click()
    download.value.save_as(tmp_path / "contacts.gpkg")
    with closing(sqlite3.connect(tmp_path / "contacts.gpkg")) as db:
        assert db.execute("SELECT name FROM contacts").fetchall() == [("uuv-1/0000",), ("uuv-1/0001",)]


@pytest.mark.realdata
def test_report_of_a_real_contact_is_one_page_in_true_metres(served, data_dir):
    path = data_dir / "surveys" / "scotsman-iver2.xtf"
    snippet = detect_in_survey(path, "0" * 64, "uuv-1", AtdStubConfig()).snippets[0]
    record = snippet.contact
    assert record.pixel_along_m is not None
    assert record.pixel_across_m is not None
    # The recording has pixels of about 4 : 1; drawn as they are, they distort by that.
    assert record.pixel_along_m > 2 * record.pixel_across_m
    pixels = Pixels.from_array(eight_bits(snippet.pixels.to_array()))
    image = image_record("00A7").model_copy(
        update={"contact": record, "pixels": pixels, "pixels_sha256": pixels.sha256}
    )
    served.state.store_image(image)
    served.client("anna").decide(ID)
    report = served.visit("bo", path=f"report/{ID}").page
    height, width = drawn_shape(report)
    metres = pixels.height_px * record.pixel_along_m, pixels.width_px * record.pixel_across_m
    assert height / width == pytest.approx(metres[0] / metres[1], rel=0.02)
    assert_pages(report, 1)
    folder = os.environ.get("SONARPOST_REPORT_FOLDER")
    if folder and report.context.browser.browser_type.name == "chromium":
        report.pdf(path=f"{folder}/report.pdf", prefer_css_page_size=True)
