"""atd_stub: retention of input files, of their entries and of stored snippets."""

from __future__ import annotations

import os
import time

import msgpack
import numpy as np
import pytest
from builders.common import eventually

from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.service import AtdStubService
from sonarpost.sonar.image_files import write_tiff

DAY_S = 86400.0


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "incoming").mkdir()
    return tmp_path / "incoming"


@pytest.fixture
def start(runner, platform, folder, tmp_path):
    def begin(**options):
        config = AtdStubConfig(
            mode="snippets", input_dir=folder, poll_s=0.05, settle_s=0.0, snippet_dir=tmp_path / "snippets", **options
        )
        return runner.start(AtdStubService(platform("uuv-1"), config))

    return begin


def add_file(folder, name, seed, text=""):
    write_tiff(folder / f"{name}.tiff", np.random.default_rng(seed).integers(0, 255, (40, 60), dtype=np.uint8))
    if text:
        (folder / f"{name}.txt").write_text(text)


def processed(service):
    return service.health().counters.get("files_processed", 0)


def run_retention(service, now_utc_s):
    """Apply the retention as the poll thread does."""
    service.stopping.set()
    service._threads[0].join()
    service._retention_due_s = 0.0
    service._apply_retention(now_utc_s)


def test_old_processed_files_are_removed_by_default_and_unprocessed_ones_stay(start, folder, tmp_path):
    service = start()
    add_file(folder, "a", 1, "lat_deg: 56.0\nlon_deg: -5.0\n")
    (folder / "a.tiff.done").touch()
    (folder / "bad.tiff").write_bytes(b"not an image")
    eventually(lambda: processed(service) == 1 and (folder / "quarantine" / "bad.tiff").exists())
    eventually(lambda: [file.path.name for file in service._processed] == ["a.tiff"])
    now_utc_s = time.time()
    run_retention(service, now_utc_s + 364 * DAY_S)
    assert (folder / "a.tiff").exists()
    add_file(folder, "unprocessed", 2)
    service._retention_due_s = 0.0
    service._apply_retention(now_utc_s + 366 * DAY_S)
    assert sorted(path.name for path in folder.iterdir()) == ["quarantine", "unprocessed.tiff"]
    assert (folder / "quarantine" / "bad.tiff").exists()
    assert list((tmp_path / "snippets").iterdir()) == []
    assert service.store.state_names("file:") == ()
    assert service.gauges()["contacts_waiting"] == 1
    counters = service.health().counters
    assert (counters["files_removed"], counters["snippets_removed"]) == (1, 1)


def test_oldest_processed_files_are_removed_above_the_maximum_size(start, folder):
    service = start(max_bytes=6000)
    for seed, name in enumerate("abc"):
        add_file(folder, name, seed)
        os.utime(folder / f"{name}.tiff", (1e9, 1e9))
        eventually(lambda expected=seed + 1: processed(service) == expected)
    eventually(lambda: len(service._processed) == 3)
    assert 3 * (folder / "a.tiff").stat().st_size > 6000
    run_retention(service, time.time())
    assert sorted(path.name for path in folder.iterdir()) == ["b.tiff", "c.tiff"]
    assert len(service.store.state_names("file:")) == 3


def test_entry_of_an_older_version_starts_its_age_at_the_upgrade(start, folder):
    service = start()
    add_file(folder, "a", 1)
    eventually(lambda: len(service._processed) == 1)
    service.stopping.set()
    service._threads[0].join()
    [name] = service.store.state_names("file:")
    with service.store.transaction() as tx:
        tx.put_state(name, msgpack.packb({"file": "a.tiff", "contacts": 1}))
    now_utc_s = time.time()
    run_retention(service, now_utc_s + 1000 * DAY_S)
    assert (folder / "a.tiff").exists()
    service._retention_due_s = 0.0
    service._apply_retention(now_utc_s + 1366 * DAY_S)
    assert not (folder / "a.tiff").exists()


def test_link_to_itself_is_skipped(start, folder):
    (folder / "loop.tiff").symlink_to(folder / "loop.tiff")
    service = start()
    add_file(folder, "a", 1)
    eventually(lambda: processed(service) == 1)
    assert service.health().state == "ok"
