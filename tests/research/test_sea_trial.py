"""`python -m research.sea_trial`: counts of the rig, claims, and the command."""

from dataclasses import replace

import pytest
from PIL import Image

from research import channel_table
from research.common.images import simulated_images
from research.sea_trial import __main__ as sea_trial
from research.sea_trial.__main__ import SIZES_PX, Cell, claims, measure, table
from research.sea_trial.rig import CodedSnippet, DeliveryCounts, send_images
from sonarpost.codec.vq.codebook import load_default
from sonarpost.codec.vq.codec import IndexPacking, VqCodec
from sonarpost.extensions.simulation.channel.parameters import ChannelParameters, build_parameters
from sonarpost.link.frames.contact_record import ContactSummary


@pytest.fixture(scope="module")
def samples() -> list[CodedSnippet]:
    codec = VqCodec(load_default(20).tiles, IndexPacking.ASCII5)
    images = simulated_images(6, 3, 140).images
    return [
        CodedSnippet(codec.encode(p.pixels[:80]), ContactSummary(lat_deg=44.0, lon_deg=-63.0, time_utc_s=1.4e9 + n))
        for n, p in enumerate(images)
    ]


def test_everything_arrives_in_a_channel_without_fading_and_nothing_beyond_the_range(samples):
    for rate, frames in ((1, 36), (4, 24)):
        found = send_images(ChannelParameters(), 300.0, rate, samples)
        assert found == DeliveryCounts(12, 12, 0, frames, frames, 6, 6, 0, 0)
    found = send_images(build_parameters({"preset": "sea-trial"}, "test"), 300.0, 1, samples)
    assert found == DeliveryCounts(12, 0, 0, 36, 0, 6, 0, 0, 0)


def test_boundary_is_that_of_the_paper_and_results_are_reproducible() -> None:
    near, far = (60, 120), (160, 250)
    cells = measure(12, 1, (*near, *far), SIZES_PX[:1])
    assert cells[:2] == measure(12, 1, near, SIZES_PX[:1])[:2]
    rate1 = {cell.range_m: cell for cell in cells if cell.rate == 1}
    assert min(rate1[range_m].packets for range_m in near) > 0.7
    assert max(rate1[range_m].packets for range_m in far) < 0.3
    assert {c.range_m: c.packets > 0.7 for c in cells if c.rate == 4} == {60: True, 120: False, 160: False, 250: False}
    assert cells[1] != measure(12, 2, near, SIZES_PX[:1])[1]


def cell(range_m: int, delivered: DeliveryCounts, width_px: int = 140) -> Cell:
    return Cell(1, width_px, 80, range_m, delivered)


def test_claims_of_the_paper_are_compared_with_the_measurement() -> None:
    whole = DeliveryCounts(4, 4, 0, 12, 12, 2, 2, 0, 0)
    second = DeliveryCounts(4, 3, 1, 12, 11, 2, 1, 1, 0)
    lost = DeliveryCounts(4, 0, 0, 12, 0, 2, 0, 0, 0)
    as_in_paper = claims([cell(60, whole), cell(60, second, 80), cell(130, lost), cell(200, lost)])
    assert [(c["measured"], c["agrees"]) for c in as_in_paper] == [(0.875, True), (1.0, True), (0.5, True), (1.0, True)]
    at_every_size = claims([cell(60, second), cell(60, second, 80)])
    assert [(c["measured"], c["agrees"]) for c in at_every_size] == [(0.75, True), (0.5, False), (0.5, False)]
    contrary = claims([cell(60, lost), cell(60, whole, 80), cell(200, whole)])
    assert [(c["measured"], c["agrees"]) for c in contrary] == [(0.5, False), (0.0, False), (0.0, False), (0.0, False)]
    text = table([cell(60, whole), replace(cell(60, lost), rate=4)])
    assert "| 60 | 100 / 100 | most received |" in text
    assert "| 60 | 0 / 0 | not tested at sea |" in text
    assert "as in the paper" in text


def test_command_prints_and_plots(tmp_path, capsys, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(sea_trial, "RANGES_M", (60, 130, 200))
    monkeypatch.setattr(sea_trial, "SIZES_PX", SIZES_PX[1:2])
    path = tmp_path / "plot.png"
    assert sea_trial.main(["--images", "3", "--plot", str(path)]) == 0
    assert capsys.readouterr().out.count("| 130 | ") == 2
    cells = measure(3, 0, (60, 130, 200), SIZES_PX[1:2])
    assert [(c.rate, c.width_px, c.range_m) for c in cells] == [(r, 80, m) for r in (1, 4) for m in (60, 130, 200)]
    assert all((cell.delivered.images, cell.delivered.packets) == (3, 6) for cell in cells)
    with Image.open(path) as image:
        assert image.size[0] > 1000


def test_delivery_table_has_every_rate_and_range() -> None:
    lines = channel_table.table(ChannelParameters(), packets=2).splitlines()
    assert len(lines) == 2 + len(channel_table.RANGES_M)
    assert lines[2].split("|")[1:4] == [" 2 ", " 54.0 ", " 100 / 100 "]
