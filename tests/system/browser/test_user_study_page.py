"""The page of the user study in a browser: from the name to the results, with the keyboard."""

import numpy as np
import pytest
from PIL import Image

from research.user_study.server import Answers, Folders, StudyApp
from sonarpost.services.console.web.server import WebServer

IMAGES = 4


@pytest.fixture
def address(tmp_path):
    for folder in ("originals", "decoded"):
        (tmp_path / folder).mkdir()
        for number in range(IMAGES):
            grey = np.random.default_rng(number).integers(0, 255, (24, 40), dtype=np.uint8)
            Image.fromarray(grey).save(tmp_path / folder / f"contact-{number}.png")
    answers = Answers(tmp_path / "panel.db")
    app = StudyApp(Folders.read(tmp_path / "originals", tmp_path / "decoded"), answers, "Which one?", choices=3, seed=1)
    server = WebServer(app.asgi, "127.0.0.1", 0)
    server.start()
    yield server.address
    server.stop()
    answers.close()


def test_participant_answers_all_trials(address, visit):
    there = visit(address, path="panel")
    there.wait("#name")
    assert there.text("h1") == "Which one?"
    there.page.keyboard.type("Anna")
    there.press("Enter")
    for number in range(1, IMAGES + 1):
        there.wait(f"h1 >> text=Image {number} of {IMAGES}")
        there.until("() => [...document.images].every(one => one.complete && one.naturalWidth > 0)")
        assert there.page.locator(".choices img").count() == 3
        # The last one is none of them.
        there.press("0" if number == IMAGES else str(1 + right(there)), "Enter")
    there.wait("h1 >> text=All images are answered")
    there.page.get_by_role("button", name="Results").click()
    there.wait("h1 >> text=Results")
    row = there.text("tr:has(th:text-is('Anna'))")
    assert "3 of 4" in row
    assert "75.0" in row


def right(there):
    """Return the index of the choice with the pixels of the shown image."""
    return there.page.evaluate(
        """() => {
          const pixels = image => {
            const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
            canvas.getContext('2d').drawImage(image, 0, 0);
            return canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data.join();
          };
          const shown = pixels(document.querySelector('.shown img'));
          return [...document.querySelectorAll('.choices img')].findIndex(one => pixels(one) === shown);
        }"""
    )
