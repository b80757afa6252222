"""`python -m research.despeckling`: figures, tables and the sheet."""

import dataclasses
import math

import numpy as np
import pytest
from PIL import Image

from research.common import images as image_sets
from research.common.speckle import SpecklePair, speckle_pairs
from research.despeckling import __main__ as command
from research.despeckling.measurement import create_filters, measure_pairs, measure_recordings


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


def test_every_filter_has_a_row_for_each_budget(pairs: list[SpecklePair]) -> None:
    filters = create_filters(command.filter_names("lee"))
    names = ["none", "network 0.25", "network 0.5", "network 0.75", "network 1", "lee", "oracle"]
    assert [each.name for each in filters] == names
    for each in filters:
        filtered, small, large = measure_pairs(each, pairs[:2], [4, 48]).rows
        assert (filtered.budget_bytes, small.budget_bytes, large.budget_bytes) == (None, 4, 48)
        assert small.misses == 2
        assert math.isnan(small.figures["clean_psnr"])
        for row in (filtered, large):
            assert row.misses == 0
            assert 10 < row.figures["clean_psnr"] <= 60
            assert row.figures["dots"] >= 0


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
    assert run("--count", 1, "--filters", "none", "--budgets", "128", "--sdvd", folder) == 0
    assert "Isolated dots in a crop of recordings" in capsys.readouterr().out
    filters = [each for each in create_filters([]) if each.function is not None]
    assert [each.name for each in filters] == ["none", "network 0.25", "network 0.5", "network 0.75", "network 1"]
    none, network = (measure_recordings(each, few.images, [128]) for each in (filters[0], filters[-1]))
    for name in ("dots_with_target", "dots_without_target"):
        assert getattr(network[1], name) < getattr(none[1], name)
    assert none[0].original_psnr == 60
