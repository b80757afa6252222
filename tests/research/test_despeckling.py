"""`python -m research.despeckling`: figures, tables, the JSON object and the sheet."""

import dataclasses
import json
import math

import numpy as np
import pytest
from PIL import Image

from research.common import images as image_sets
from research.common.speckle import SpecklePair, speckle_pairs
from research.despeckling import __main__ as command
from research.despeckling.measurement import create_filters, measure_pairs


@pytest.fixture(scope="module")
def pairs() -> list[SpecklePair]:
    return speckle_pairs(4, seed=3, pings=180)


@pytest.fixture
def few_pairs(pairs: list[SpecklePair], monkeypatch: pytest.MonkeyPatch) -> None:
    """The command uses the first of `pairs`."""
    monkeypatch.setattr(command, "speckle_pairs", lambda count, seed: pairs[:count])


def test_network_improves_the_decoded_images(pairs: list[SpecklePair]) -> None:
    by_name = {each.name: each for each in create_filters([])}
    names = ("none", "network 1", "oracle")
    none, network, oracle = (measure_pairs(by_name[name], pairs[:3], [64, 256]) for name in names)
    for result in (none, network, oracle):
        assert [row.budget_bytes for row in result.rows] == [None, 64, 256]
        assert [row.misses for row in result.rows] == [0, 0, 0]
    assert none.rows[0].figures["original_psnr"] == oracle.rows[0].figures["clean_psnr"] == 60
    assert none.rows[0].figures["highlight_error_original"] == 0
    assert oracle.rows[0].figures["shadow_error_px"] == 0
    assert math.isnan(oracle.filter_ms)
    psnr = [[row.figures["clean_psnr"] for row in result.rows[1:]] for result in (none, network, oracle)]
    assert psnr[0][1] + 0.5 < psnr[1][1] < psnr[2][1]
    assert psnr[0][0] < psnr[1][0]


def run(*arguments: object) -> int:
    return command.run(command.new_parser().parse_args([str(argument) for argument in arguments]))


@pytest.mark.usefixtures("few_pairs")
def test_json_object_of_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--count", 2, "--filters", "lee", "--budgets", "4,48", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["pairs"], found["seed"], found["sdvd"]) == (2, 0, [])
    names = ["none", "network 0.25", "network 0.5", "network 0.75", "network 1", "lee", "oracle"]
    assert [row["filter"] for row in found["results"]] == [name for name in names for _ in range(3)]
    for row in found["results"]:
        if row["budget"] == 4:
            assert row["misses"] == 2
            assert row["clean_psnr"] is None
        else:
            assert row["misses"] == 0
            assert 10 < row["clean_psnr"] <= 60
            assert row["dots"] >= 0


@pytest.mark.usefixtures("few_pairs")
def test_tables_and_sheet_of_the_command(pairs, tmp_path, capsys):
    sheet = tmp_path / "new" / "sheet.png"
    assert run("--count", 2, "--filters", "none", "--budgets", "40", "--sheet", sheet) == 0
    output = capsys.readouterr().out
    assert "2 simulated pairs" in output
    assert sum(line.startswith("network 1 ") for line in output.splitlines()) == 4
    with Image.open(sheet) as image:
        drawn = np.asarray(image.convert("L"))
    chosen = command.sheet_pairs(pairs[:2])
    first = chosen[0].clean.repeat(2, 0).repeat(2, 1)
    assert np.array_equal(drawn[56 : 56 + first.shape[0], 20 : 20 + first.shape[1]], first)
    assert command.sheet_pairs(pairs) == sorted(pairs, key=lambda pair: pair.seabed)


@pytest.mark.realdata
@pytest.mark.usefixtures("few_pairs")
def test_network_removes_dots_from_recordings(data_dir, monkeypatch, capsys):
    crops = image_sets.sdvd_crops(data_dir / "snippets" / "sdvd")
    few = dataclasses.replace(crops, images=crops.images[::28])
    monkeypatch.setattr(command, "sdvd_crops", lambda _: few)
    folder = data_dir / "snippets" / "sdvd"
    assert run("--count", 1, "--filters", "none", "--budgets", "128", "--sdvd", folder, "--json") == 0
    rows = {(row["filter"], row["budget"]): row for row in json.loads(capsys.readouterr().out)["sdvd"]}
    assert {name for name, _ in rows} == {"none", "network 0.25", "network 0.5", "network 0.75", "network 1"}
    for name in ("dots_with_target", "dots_without_target"):
        assert rows["network 1", 128][name] < rows["none", 128][name]
    assert rows["none", None]["original_psnr"] == 60
