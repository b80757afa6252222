"""User study: blind trials in an order of each participant, one answer a question, results with intervals."""

import io
import json

import numpy as np
import pytest
from PIL import Image
from PIL.PngImagePlugin import PngInfo
from starlette.testclient import TestClient

from research.user_study.__main__ import main
from research.user_study.server import Answers, Folders, StudyApp
from research.user_study.trials import Answer, Decoded, share, trials_for

NAMES = [f"contact-{number}" for number in range(6)]


@pytest.fixture
def folders(tmp_path):
    for folder in ("originals", "decoded/small", "decoded/large"):
        path = tmp_path / folder
        path.mkdir(parents=True)
        for number, name in enumerate(NAMES):
            remark = PngInfo()
            remark.add_text("Title", name)
            grey = np.full((20, 20), 10 * number + len(folder), np.uint8)
            Image.fromarray(grey).save(path / f"{name}.png", pnginfo=remark)
    return tmp_path / "originals", tmp_path / "decoded"


@pytest.fixture
def panel(folders, tmp_path):
    answers = Answers(tmp_path / "state" / "panel.db")
    app = StudyApp(Folders.read(*folders), answers, "Which?", choices=3, seed=1)
    with TestClient(app.asgi, base_url="http://127.0.0.1", client=("127.0.0.1", 1)) as client:
        yield client
    answers.close()


def start(client, name="Anna"):
    """Start as a participant; return the header of the session."""
    return {"X-Panel": client.post("/api/panel/start", json={"name": name}).json()["panel"]}


def body_of(**changes):
    return {"number": 1, "choice": 0, "sure": None, "seconds": 1.0, **changes}


def grey_of(client, address) -> int:
    return int(np.asarray(Image.open(io.BytesIO(client.get(address).content)))[0, 0])


def right_choice(client, question) -> int:
    """The right choice by grey level; the folder names `decoded/small` and `decoded/large` have 13 characters."""
    shown = grey_of(client, question["shown"]) - len("decoded/small")
    return [grey_of(client, address) - len("originals") for address in question["choices"]].index(shown)


def test_study_from_the_first_trial_to_the_results(panel, tmp_path, capsys):
    assert panel.get("/api/panel").json() == {"title": "Which?", "trials": 12, "choices": 3}
    assert panel.get("/api/panel/next").status_code == 401
    headers = start(panel)
    for number in range(1, 13):
        question = panel.get("/api/panel/next", headers=headers).json()
        assert (question["number"], question["of"], len(question["choices"])) == (number, 12, 3)
        choice = right_choice(panel, question) if number <= 10 else -1
        body = {"number": number, "choice": choice, "sure": 0.5, "seconds": float(number)}
        answer = panel.post("/api/panel/answers", json=body, headers=headers)
        assert (answer.status_code, answer.json()) == (201, {"answered": number})
    assert panel.get("/api/panel/next", headers=headers).json() == {"done": True, "answered": 12}
    assert panel.post("/api/panel/answers", json=body, headers=headers).status_code == 409
    found = panel.get("/api/panel/results").json()
    [anna] = found["people"]
    assert (anna["name"], anna["right"], anna["answered"], anna["median_s"]) == ("Anna", 10, 12, 7.0)
    assert anna["wilson"][0] < 10 / 12 < anna["wilson"][1]
    assert set(found["by_group"]) == {"small", "large"}
    assert found["chance"] == pytest.approx(1 / 3)
    assert main(["--state", str(tmp_path / "state"), "--results"]) == 0
    printed = capsys.readouterr().out
    assert "Anna" in printed
    assert "[large]" in printed
    assert "by chance 0.33" in printed
    assert main(["--state", str(tmp_path / "state"), "--results", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == found


def test_responses_do_not_reveal_the_answer(panel):
    headers = start(panel)
    question = panel.get("/api/panel/next", headers=headers)
    assert not any(name in question.text for name in (*NAMES, "small", "large"))
    for address in (question.json()["shown"], *question.json()["choices"]):
        data = panel.get(address).content
        assert not any(name.encode() in data for name in NAMES)
    assert panel.get("/api/panel/images/contact-1.png").status_code == 404
    assert set(panel.post("/api/panel/answers", json=body_of(), headers=headers).json()) == {"answered"}


def test_participant_continues_and_another_has_another_order(panel):
    started = panel.post("/api/panel/start", json={"name": "Anna"}).json()
    headers = {"X-Panel": started["panel"]}
    first = panel.get("/api/panel/next", headers=headers).json()
    panel.post("/api/panel/answers", json=body_of(), headers=headers)
    again = panel.post("/api/panel/start", json={"name": "Anna"}).json()
    assert again == {**started, "answered": 1}
    assert panel.get("/api/panel/next", headers=start(panel, "Bo")).json()["shown"] != first["shown"]
    orders = [[t.shown for t in trials_for(who, 1, NAMES, [Decoded("", n) for n in NAMES], 3)] for who in "ab"]
    assert orders[0] != orders[1]
    assert set(orders[0]) == set(orders[1])


def test_error_names_the_invalid_field(panel):
    headers = start(panel)
    for field, value in (("choice", 3), ("number", 2), ("seconds", -1.0), ("sure", 2)):
        answer = panel.post("/api/panel/answers", json=body_of(**{field: value}), headers=headers)
        assert (answer.status_code, answer.json()["error"]["field"]) == (400, field)


def test_results_are_available_on_this_host_only(folders, tmp_path):
    answers = Answers(tmp_path / "panel.db")
    app = StudyApp(Folders.read(*folders), answers, "Which?", choices=3, seed=1)
    with TestClient(app.asgi, base_url="http://127.0.0.1", client=("10.0.0.7", 1)) as client:
        assert client.get("/api/panel/results").status_code == 403
    answers.close()


def interval(method, right, number):
    return share([Answer("ann", "small", n < right, 1.0) for n in range(number)])[method]


def test_confidence_intervals():
    # Published values for 18 of 20 at 95 %.
    assert interval("wilson", 18, 20) == [pytest.approx(0.699, abs=1e-3), pytest.approx(0.972, abs=1e-3)]
    assert interval("exact", 18, 20) == [pytest.approx(0.683, abs=1e-3), pytest.approx(0.988, abs=1e-3)]
    assert interval("wilson", 0, 0) == interval("exact", 0, 0) == [0.0, 1.0]
    assert interval("exact", 20, 20)[1] == 1.0
    assert interval("wilson", 0, 5)[0] == 0.0
