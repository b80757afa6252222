"""atd_stub: retention of input files, of their entries and of stored snippets."""

import os
import time
from types import SimpleNamespace

import numpy as np
import pytest
from builders.common import eventually

from sonarpost.services.atd_stub import service as atd_stub
from sonarpost.sonar.image_files import write_tiff

DAY_S = 86400.0


@pytest.fixture
def clock(monkeypatch):
    """Clocks of the retention that can be ahead of the real ones; the service applies it with each poll."""
    ahead = SimpleNamespace(days=0.0)
    now = lambda: time.time() + ahead.days * DAY_S  # noqa: E731
    simulated = SimpleNamespace(time=now, monotonic=time.monotonic, perf_counter=time.perf_counter)
    monkeypatch.setattr(atd_stub, "time", simulated)
    steady = SimpleNamespace(time=now, monotonic=lambda: time.monotonic() + ahead.days * DAY_S)
    monkeypatch.setattr("sonarpost.runtime.retention.time", steady)
    monkeypatch.setattr(atd_stub, "INTERVAL_S", 0.0)
    return ahead


@pytest.fixture
def start(start_service, tmp_path):
    return lambda **options: start_service(
        mode="snippets", max_in_flight=8, snippet_dir=tmp_path / "snippets", **options
    )


@pytest.fixture
def add_file(incoming):
    """Add an image whose age is counted from its processing."""

    def add(name, seed):
        pixels = np.random.default_rng(seed).integers(0, 255, (40, 60), dtype=np.uint8)
        write_tiff(incoming / f".{name}.tiff", pixels)
        os.utime(incoming / f".{name}.tiff", (1e9, 1e9))
        (incoming / f".{name}.tiff").rename(incoming / f"{name}.tiff")

    return add


def processed(service):
    return service.health().counters.get("files_processed", 0)


def test_old_processed_files_are_removed_by_default_and_unprocessed_ones_stay(
    start, clock, add_file, incoming, tmp_path
):
    service = start(settle_s=3600.0)
    (incoming / "a.txt").write_text("lat_deg: 56.0\nlon_deg: -5.0\n")
    add_file("a", 1)
    add_file("unprocessed", 3)
    (incoming / "bad.tiff").write_bytes(b"not an image")
    for name in "a", "b", "bad":
        (incoming / f"{name}.tiff.done").touch()
    eventually(lambda: processed(service) == 1 and (incoming / "quarantine" / "bad.tiff").exists())
    clock.days = 366.0
    add_file("b", 2)  # newer, which shows that the clock is right
    eventually(lambda: processed(service) == 2)
    eventually(lambda: service.health().counters.get("files_removed") == 1)
    eventually(lambda: len(service.store.state_names("file:")) == 1)
    left = ["b.tiff", "b.tiff.done", "bad.tiff.done", "quarantine", "unprocessed.tiff"]
    assert sorted(path.name for path in incoming.iterdir()) == left
    assert (incoming / "quarantine" / "bad.tiff").exists()
    assert service.gauges()["contacts_waiting"] == 2, "what is not sent stays"
    [first, second] = sorted((tmp_path / "snippets").glob("*.tiff"), key=lambda path: path.stat().st_mtime)
    for path in (tmp_path / "snippets").glob(f"{first.stem}.*"):
        os.utime(path, (path.stat().st_mtime - 366 * DAY_S,) * 2)
    eventually(lambda: service.health().counters.get("snippets_removed") == 1)
    assert second.exists()


def test_oldest_processed_files_are_removed_above_the_maximum_size(start, clock, add_file, incoming):
    service = start(max_bytes=6000)
    for seed, name in enumerate("abc"):
        add_file(name, seed)
        eventually(lambda expected=seed + 1: processed(service) == expected)
    eventually(lambda: not (incoming / "a.tiff").exists())
    assert 3 * (incoming / "b.tiff").stat().st_size > 6000
    assert sorted(path.name for path in incoming.iterdir()) == ["b.tiff", "c.tiff"]
    assert len(service.store.state_names("file:")) == 3


def test_link_to_itself_is_skipped(start, add_file, incoming):
    (incoming / "loop.tiff").symlink_to(incoming / "loop.tiff")
    service = start()
    add_file("a", 1)
    eventually(lambda: processed(service) == 1)
    assert service.health().state == "ok"
