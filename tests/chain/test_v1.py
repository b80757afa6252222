"""The chain with v1 in real processes: every preview through lossy water, detail by reports, orders to the vehicle."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from chain.conftest import RunningChain

from sonarpost.cli.demo.account import settle

pytestmark = pytest.mark.chain

StartChain = Callable[..., RunningChain]
PICTURES = 6


def whole(run: RunningChain) -> bool:
    """All that was encoded is ashore, complete."""
    encoded = run.watcher.encoded
    return len(encoded) == PICTURES and all(i in run.watcher.shore and run.watcher.shore[i].complete for i in encoded)


@pytest.mark.parametrize("killed", [pytest.param(None, marks=pytest.mark.long), "op_modem"])
def test_with_a_third_of_the_frames_lost_every_picture_is_ashore(start_chain: StartChain, killed: str | None) -> None:
    run = start_chain(link="v1", loss=0.3)
    run.deposit(PICTURES)
    if killed is not None:
        run.until(lambda: len(run.watcher.shore) >= 1, 60, "first preview ashore")
        run.chain.kill(killed)
        run.chain.start(killed)
    run.until(lambda: len(run.watcher.shore) == PICTURES, 60, "every preview ashore")
    run.until(lambda: whole(run), 120, "every picture ashore")
    run.until_idle()
    result = settle(run.settings, PICTURES, 0.0)
    assert result.frames_lost > 0
    assert result.images_vessel == result.images_shore == result.images_complete == PICTURES
    assert result.sha256_match
    assert result.missing_ashore == ()
    assert all(image.codec == "emb" and image.missing_fraction == 0.0 for image in run.watcher.shore.values())
