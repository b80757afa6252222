"""`python -m research.link`: the schemes over the same channel, and its one JSON line."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from research.link.__main__ import main
from research.link.schemes import Codecs, LinkImage, LossyChannel, Setting, run_bound, run_paper, run_sequential, run_v1
from sonarpost.link.coding.channel_capacity import LossChannel


@pytest.fixture(scope="module")
def codecs() -> Codecs:
    return Codecs.shipped()


@pytest.fixture(scope="module")
def images(codecs: Codecs) -> list[LinkImage]:
    rng = np.random.default_rng(0)
    found = []
    for number in range(6):
        slope = np.add.outer(np.arange(32) * (number + 1), np.arange(48) * 2) % 200
        found.append(codecs.code((slope + rng.integers(0, 40, slope.shape)).astype(np.uint8), number, 600))
    return found


def setting(loss: float, burst: float = 1.0) -> Setting:
    return Setting(6, 64, LossChannel(loss, burst), group=24, depth=2, seed=3)


def test_channel_has_the_configured_loss_and_burst_length() -> None:
    channel = LossyChannel(LossChannel(0.3, 5.0), 0)
    received = np.array([channel.receives() for _ in range(40_000)])
    assert 1 - received.mean() == pytest.approx(0.3, abs=0.02)
    assert (~received[:-1]).sum() / (~received[:-1] & received[1:]).sum() == pytest.approx(5.0, rel=0.1)


def test_everything_arrives_without_loss(codecs: Codecs, images: list[LinkImage]) -> None:
    lossless = setting(0.0)
    for result in (
        run_paper(images, codecs, lossless),
        run_sequential(images, codecs, lossless),
        run_v1(images, codecs, lossless, feedback=False),
        run_v1(images, codecs, lossless, feedback=True),
    ):
        assert all(d.has_preview and d.is_complete for d in result.delivered)
        assert result.frames / len(images) == pytest.approx(6, abs=0.8)
    ideal, plain = run_bound(images, codecs, lossless), run_sequential(images, codecs, lossless)
    for best, found in zip(ideal.delivered, plain.delivered, strict=True):
        assert best.quality.psnr >= found.quality.psnr - 0.2


def test_bound_is_the_expectation_over_received_frames(codecs: Codecs, images: list[LinkImage]) -> None:
    two = Setting(2, 64, LossChannel(0.5), group=24, depth=2, seed=0)
    (best, *_) = run_bound(images, codecs, two).delivered
    qualities = [images[0].quality(codecs.emb, n).psnr for n in (0, 39, 103)]
    assert best.quality.psnr == pytest.approx(0.25 * qualities[0] + 0.5 * qualities[1] + 0.25 * qualities[2])
    assert best.payload_bytes == 64


def test_feedback_completes_all_images_at_half_loss(codecs: Codecs, images: list[LinkImage]) -> None:
    result = run_v1(images, codecs, setting(0.5, 4.0), feedback=True)
    assert all(d.is_complete for d in result.delivered)
    assert result.reports > 0


def test_command_prints_one_json_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(5)
    for number in range(8):
        pixels = np.add.outer(np.arange(32) * number, np.arange(32) * 3) % 180 + rng.integers(0, 60, (32, 32))
        Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / f"{number}.png")
    command = ["--images", str(tmp_path), "--loss", "0.3", "--burst", "1,4", "--frames", "5", "--json"]
    assert main(command) == 0
    first = capsys.readouterr().out
    read = json.loads(first.strip().splitlines()[-1])
    assert read["images"] == 8
    schemes = ("paper", "sequential", "v1-broadcast", "v1-feedback", "bound")
    found = [(r["scheme"], r["burst"]) for r in read["results"]]
    assert found == [(scheme, burst) for burst in (1.0, 4.0) for scheme in schemes]
    for row in read["results"]:
        needed = {"loss", "bytes", "psnr", "ssim", "preview_rate", "complete_rate", "airtime_ratio"}
        assert needed <= set(row)
        assert row["airtime_ratio"] is None or row["airtime_ratio"] >= 1.0
    by_scheme = {r["scheme"]: r for r in read["results"] if r["burst"] == 1.0}
    assert by_scheme["paper"]["psnr"] < by_scheme["sequential"]["psnr"] < by_scheme["v1-broadcast"]["psnr"]
    assert {by_scheme[s]["bytes"] for s in ("paper", "sequential", "v1-broadcast", "bound")} == {320}
    assert main(command) == 0
    assert capsys.readouterr().out == first
