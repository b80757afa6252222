"""`sonarpost survey view`: the page, its places and picks; requests of other pages; the command."""

import signal
import subprocess
import sys
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from builders.speckle_survey import make_survey
from builders.xtf import write_xtf
from PIL import Image
from starlette.testclient import TestClient

from sonarpost.cli.main import main
from sonarpost.detection.picks import Pick, parse_picks
from sonarpost.detection.settings import DetectorSettings
from sonarpost.errors import ConfigError
from sonarpost.extensions.survey_view import waterfall as waterfall_module
from sonarpost.extensions.survey_view.command import detected, stored_picks
from sonarpost.extensions.survey_view.waterfall import Waterfall
from sonarpost.extensions.survey_view.web import DetectedContacts, SurveyViewApp
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.source import InMemorySource
from sonarpost.sonar.survey import Side

__all__ = ["make_survey"]

TOKEN = "t0ken"


@pytest.fixture(scope="module")
def survey(make_survey):
    return make_survey({"side": Side.STARBOARD, "ping": 120})


@pytest.fixture(scope="module")
def file(survey, tmp_path_factory):
    path = tmp_path_factory.mktemp("view") / "line7.xtf"
    write_xtf(survey, path)
    return path


@pytest.fixture
def waterfall(survey, tmp_path):
    return Waterfall(InMemorySource(survey, SurveyOptions()), tmp_path)


@pytest.fixture
def contacts():
    return DetectedContacts()


@pytest.fixture
def out(tmp_path):
    return tmp_path / "line 7.xtf.picks"


@pytest.fixture
def client(survey, waterfall, contacts, out):
    info = InMemorySource(survey, SurveyOptions()).info
    app = SurveyViewApp(info, waterfall, contacts, [], out, ["sonarpost", "detect", "line 7.xtf"], TOKEN)
    return TestClient(app.asgi, base_url=f"http://127.0.0.1:8000/{TOKEN}/")


# Waterfall


def test_every_pixel_has_the_place_of_its_sample(waterfall):
    assert (waterfall.rows, waterfall.side_px, waterfall.pings_per_row) == (200, 512, 1)
    assert waterfall.stretch == pytest.approx(0.1 / (20 / 512), rel=0.1)
    for side, sample in ((Side.PORT, 0), (Side.PORT, 511), (Side.STARBOARD, 0), (Side.STARBOARD, 300)):
        row, column = waterfall.pixel(120, side, sample)
        place = waterfall.place(row, column)
        assert (place.pick, place.ping_index) == (Pick(1120, side, sample), 120)
        assert waterfall.ping_index_of(place.pick) == 120
        assert place.slant_range_m == pytest.approx((sample + 0.5) * 20 / 512)
        assert (place.lat_deg is None) == (place.slant_range_m <= 3.0)


def test_tiles_are_the_waterfall(waterfall, monkeypatch, tmp_path):
    monkeypatch.setattr(waterfall_module, "TILE_ROWS", 64)
    assert waterfall.tiles == 4
    tiles = []
    for number in range(4):
        path = tmp_path / f"{number}.png"
        path.write_bytes(waterfall.tile(number))
        tiles.append(np.asarray(Image.open(path)))
    image = np.vstack(tiles)
    assert image.shape == (200, 1024)
    row, column = waterfall.pixel(120, Side.STARBOARD, 250)
    assert image[row - 2 : row + 2, column - 3 : column + 3].mean() > image.mean() + 60


def test_long_recording_has_several_pings_a_row(survey, tmp_path, monkeypatch):
    monkeypatch.setattr(waterfall_module, "MAX_ROWS", 60)
    waterfall = Waterfall(InMemorySource(survey, SurveyOptions()), tmp_path)
    assert (waterfall.rows, waterfall.pings_per_row) == (50, 4)
    place = waterfall.place(*waterfall.pixel(121, Side.STARBOARD, 250))
    assert place.pick == Pick(122, Side.STARBOARD, 250, by_index=True)
    assert waterfall.ping_index_of(place.pick) == 122


def test_repeated_ping_numbers_give_picks_by_index(survey, tmp_path):
    pings = tuple(replace(ping, number=7) for ping in survey.pings)
    waterfall = Waterfall(InMemorySource(replace(survey, pings=pings), SurveyOptions()), tmp_path)
    assert waterfall.place(9, 3).pick.by_index
    with pytest.raises(ConfigError):
        waterfall.ping_index_of(Pick(7, Side.PORT, 3))


# Page


def test_page_and_its_files_are_served_without_external_resources(client):
    page = client.get("")
    assert page.status_code == 200
    assert "default-src 'none'" in page.headers["content-security-policy"]
    for name in ("static/view.js", "static/view.css", "static/icon.svg"):
        assert client.get(name).status_code == 200
        assert name in page.text
    assert "http" not in page.text


def test_contacts_appear_when_the_detection_ends(client, contacts, file):
    assert client.get("contacts").json() == {"state": "running", "message": "", "contacts": []}
    contacts.finish(detected(file, SurveyOptions(), DetectorSettings()))
    answer = client.get("contacts").json()
    assert answer["state"] == "done"
    (contact,) = answer["contacts"]
    assert contact["row"] == pytest.approx(120, abs=3)
    assert contact["column"] == pytest.approx(512 + 250, abs=8)
    assert contact["rows"][0] <= contact["row"] < contact["rows"][1]
    contacts.fail("the file has changed")
    assert client.get("contacts").json()["message"] == "the file has changed"


def test_click_gives_the_place_with_its_snippet(client):
    place = client.get("place?row=120&column=762").json()["place"]
    expected = {"pick": "1120,starboard,250", "ping_number": 1120, "side": "starboard", "sample": 250}
    assert place | expected == place
    assert place["slant_range_m"] == pytest.approx(9.785, abs=0.01)
    assert place["lat_deg"] == pytest.approx(60.0, abs=0.01)
    assert client.get("snippet.png?row=120&column=762").headers["content-type"] == "image/png"
    assert client.get("tile/0.png").content.startswith(b"\x89PNG")


def test_saved_picks_are_read_again_and_the_command_is_shown(client, out, survey):
    picks = ["1120,starboard,250", "index:3,port,4", "1120,starboard,250"]
    answer = client.post("picks", json={"picks": picks}).json()
    assert answer["command"] == ("sonarpost detect 'line 7.xtf' --pick 1120,starboard,250 --pick index:3,port,4")
    assert out.read_text() == "1120,starboard,250\nindex:3,port,4\n"
    assert [each["pick"] for each in client.get("info").json()["picks"]] == picks[:2]
    source = InMemorySource(survey, SurveyOptions())
    assert [row for _, row in stored_picks(source, out)] == [120, 3]
    assert parse_picks(out.read_bytes(), "")[1] == ()
    assert client.post("picks", json={"picks": []}).json()["picks"] == 0
    assert out.read_text() == ""


PICKS = [
    *('"1,port,2"', "[1]", '["1,port"]', '["1120,port,512"]', '["1,port,2"]', '["index:200,port,2"]'),
    *('["index:999999999999999999,port,2"]', '["1120,port,2\\n1,port,1"]', '[], "out": "/etc/passwd"'),
    '["' + "9" * 5000 + ',port,1"]',
]


@pytest.mark.parametrize("body", ["", "[]", *(f'{{"picks": {picks}}}' for picks in PICKS)], ids=lambda body: body[:30])
def test_invalid_picks_are_not_saved(client, out, body):
    answer = client.post("picks", content=body.encode())
    assert answer.status_code == 400
    assert answer.json()["error"]
    assert client.post("picks", content=b"x" * 70_000).status_code == 413
    assert not out.exists()


def test_place_that_is_no_number_is_refused(client):
    for value in ("", "-1", "x", "1e3", "²", "9" * 5000, "1.5", "NaN"):
        for path in ("place", "snippet.png"):
            assert client.get(path, params={"row": value, "column": "3"}).status_code == 400
        assert client.get(f"tile/{value}.png").status_code in (400, 404)


def test_place_outside_the_image_is_not_found(client):
    for row, column in ((200, 0), (0, 1024), (999_999_999_999, 0)):
        assert client.get(f"place?row={row}&column={column}").status_code == 404
        assert client.get(f"snippet.png?row={row}&column={column}").status_code == 404
    assert client.get("tile/1.png").status_code == 404


def test_other_hosts_origins_and_tokens_are_refused(client, out):
    assert client.get("info", headers={"host": "attacker.example"}).status_code == 400
    origin = {"origin": "http://attacker.example"}
    assert client.post("picks", json={"picks": []}, headers=origin).status_code == 403
    for path in ("/", "/info", "/wrong/info", f"/{TOKEN}x/info", "/static/view.js", "//info", "/%ff/info"):
        assert client.get(f"http://127.0.0.1:8000{path}").status_code == 404, path
    assert not out.exists()


def test_files_outside_the_static_folder_are_not_served(client):
    for path in ("../web.py", "%2e%2e/web.py", "..%2fweb.py", "/etc/passwd", ""):
        assert client.get(f"static/{path}").status_code == 404, path


# Command


def test_command_serves_until_a_signal(file, tmp_path):
    command = [sys.executable, "-m", "sonarpost.cli.main", "survey", "view", str(file), "--out", str(tmp_path / "p")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        address = process.stdout.readline().strip()
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(f"{address}info") as answer:
            assert b'"pings":200' in answer.read()
        process.send_signal(signal.SIGINT)
        process.communicate()
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 0


def test_unreadable_picks_are_an_error_and_stay(file, tmp_path, capsys):
    out = tmp_path / "old.picks"
    out.write_text("1120,port,3\nnonsense\n")
    assert main(["survey", "view", str(file), "--out", str(out)]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith(f"sonarpost: {out} line 2: place: got 'nonsense'")
    assert out.read_text() == "1120,port,3\nnonsense\n"


def test_invalid_option_is_status_2(file, capsys):
    for option, value in (("--port", "70000"), ("--threshold", "3"), ("--crs", "EPSG:4326")):
        assert main(["survey", "view", str(file), option, value]) == 2
        assert len(capsys.readouterr().err.splitlines()) == 1
