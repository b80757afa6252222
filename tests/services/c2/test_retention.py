"""c2: index and retention of images."""

import time
from dataclasses import replace

import pytest
from builders.common import eventually
from builders.records import decision_record, reconstructed_image
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.archive.shore_files import find_image, select_images
from sonarpost.archive.shore_index import FILE_NAME, DecisionRow, ImageRow, ShoreIndex
from sonarpost.errors import StoredFileError
from sonarpost.messages import Pixels
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config

DAY_S = 86400.0
START_UTC_S = 1_700_000_000.0


def image(image_id="AAAA", version=1, vessel="vessel-1", first_frame_utc_s=1_700_000_000.0):
    picture = Pixels(height_px=20, width_px=30, bits=8, data=bytes([version]) * 600)
    return reconstructed_image(
        picture,
        vessel_id=vessel,
        image_id=image_id,
        version=version,
        first_frame_utc_s=first_frame_utc_s,
        last_frame_utc_s=first_frame_utc_s + 1,
    )


def row(name, accepted_utc_s=0.0, size_bytes=100, exported_utc_s=None, **changes):
    fields = {
        "vessel_id": "vessel-1",
        "name": name,
        "vehicle_id": "uuv-1",
        "image_id": "AAAA",
        "version": 1,
        "first_frame_utc_s": 0.0,
        "last_frame_utc_s": 0.0,
        "relayed_utc_s": None,
        "accepted_utc_s": accepted_utc_s,
        "complete": True,
        "missing_fraction": 0.0,
        "height_px": 1,
        "width_px": 1,
        "codec": "vq",
        "lat_deg": None,
        "lon_deg": None,
        "atd_class": None,
        "atd_confidence": None,
        "size_bytes": size_bytes,
        "exported_utc_s": exported_utc_s,
    }
    return ImageRow(**(fields | changes))


@pytest.fixture
def archive(tmp_path):
    made = []

    def open_(**options):
        made.append(Archive(C2Config(out_dir=tmp_path / "out", **options)))
        return made[-1]

    yield open_
    for each in made:
        each.close()


def images_in(folder):
    return sorted(path.name for path in folder.glob("*/*.tiff"))


def test_retention_removes_exported_images_first_then_the_oldest():
    rows = [row("a", 1), row("b", 2), row("c", 3, exported_utc_s=9.0), row("d", 4, exported_utc_s=9.0)]
    assert [r.name for r in select_images(rows, (), 10.0, None, 250)] == ["c", "d"]
    assert [r.name for r in select_images(rows, (), 10.0, None, 100)] == ["c", "d", "a"]
    assert select_images(rows, (), 10.0, None, 400) == []


def test_images_without_a_decision_are_removed_last():
    decision = DecisionRow.of(decision_record(vehicle_id="uuv-1", image_id="BBBB"), 5.0)
    rows = [row("a", 1), row("b", 2, image_id="BBBB"), row("c", 3, exported_utc_s=9.0)]
    assert [r.name for r in select_images(rows, [decision], 10.0, None, 100)] == ["c", "b"]
    assert [r.name for r in select_images(rows, [decision], 10.0, None, 0)] == ["c", "b", "a"]


def test_retention_is_on_by_default(archive, tmp_path):
    stored = archive()
    stored.store_image(image("AAAA"), 5.0)
    stored.flush()
    assert stored.apply_retention(time.time() + 364 * DAY_S) == []
    assert [r.image_id for r in stored.apply_retention(time.time() + 366 * DAY_S)] == ["AAAA"]
    assert images_in(tmp_path / "out") == []
    assert C2Config().max_bytes == 50_000_000_000


def test_retention_removes_old_images_below_the_size_limit():
    rows = [row("old", START_UTC_S), row("new", START_UTC_S + 5 * DAY_S)]
    now_utc_s = START_UTC_S + 6 * DAY_S
    assert [r.name for r in select_images(rows, (), now_utc_s, 3.0, None)] == ["old"]
    assert [r.name for r in select_images(rows, (), now_utc_s, 3.0, 10)] == ["old", "new"]


@given(
    st.lists(st.tuples(st.floats(0, 1e6), st.integers(0, 1000), st.booleans()), max_size=20),
    st.none() | st.floats(0.001, 20),
    st.none() | st.integers(0, 5000),
)
def test_retention_keeps_the_limits_and_removes_no_more_than_needed(pictures, days, limit):
    rows = [row(str(n), START_UTC_S + at, size, 1.0 if done else None) for n, (at, size, done) in enumerate(pictures)]
    now_utc_s = START_UTC_S + 1e6
    removed = select_images(rows, (), now_utc_s, days, limit)
    kept = [r for r in rows if r not in removed]
    assert len(removed) == len(set(removed))
    if days is not None:
        assert all(now_utc_s - r.accepted_utc_s <= days * DAY_S for r in kept)
    if limit is not None:
        assert sum(r.size_bytes for r in kept) <= limit
    if removed and limit is not None and (days is None or now_utc_s - removed[-1].accepted_utc_s <= days * DAY_S):
        assert sum(r.size_bytes for r in kept) + removed[-1].size_bytes > limit
    if days is None and limit is None:
        assert removed == []


def test_retention_deletes_files_and_keeps_decisions(archive, tmp_path):
    kept = archive(max_bytes=0)
    kept.store_image(image("AAAA"), 5.0)
    kept.flush()
    kept.store_image(image("BBBB"), 5.0)
    kept.flush()
    kept.store_decision(decision_record())
    kept.flush()
    removed = kept.apply_retention(1e9)
    assert [r.image_id for r in removed] == ["AAAA", "BBBB"]
    assert sorted(p.name for p in (tmp_path / "out").rglob("*") if p.is_file() and FILE_NAME not in p.name) == [
        f"{b'd1'.hex()}.json"
    ]
    assert kept.images_bytes() == 0
    assert len(kept.index().images(removed=True)) == 2
    assert {r.removed_utc_s for r in kept.index().images(removed=True)} == {1e9}
    assert len(kept.index().decisions()) == 1
    assert kept.apply_retention(2e9) == []


def test_exported_image_is_removed_before_an_older_one(archive):
    kept = archive()
    kept.store_image(image("AAAA"), 5.0)
    kept.flush()
    kept.store_image(image("BBBB"), 5.0)
    kept.flush()
    index = kept.index()
    size = index.size_bytes()
    index.mark("exported_utc_s", [r for r in index.images() if r.image_id == "BBBB"], 7.0)
    limited = archive(max_bytes=size - 1)
    assert [r.image_id for r in limited.apply_retention(time.time())] == ["BBBB"]


def test_removed_image_that_arrives_again_is_stored(archive, tmp_path):
    kept = archive(max_bytes=0)
    assert kept.store_image(image(), 5.0).is_new
    kept.flush()
    kept.apply_retention(1.0)
    assert kept.store_image(image(), 5.0).is_new
    kept.flush()
    assert len(kept.index().images()) == 1
    assert not kept.store_image(image(), 5.0).is_new
    kept.flush()


def test_index_is_completed_from_the_files(archive, tmp_path):
    first = archive()
    first.store_image(image("AAAA", 1), 5.0)
    first.flush()
    first.store_image(image("AAAA", 2), 5.0)
    first.flush()
    first.store_decision(decision_record())
    first.flush()
    before = [replace(r, relayed_utc_s=None, accepted_utc_s=0.0) for r in first.index().images()]
    first.close()
    for path in (tmp_path / "out").glob(f"{FILE_NAME}*"):
        path.unlink()
    (tmp_path / "out" / "vessel-1" / "broken.json").write_text("{")
    again = archive()
    assert [replace(r, accepted_utc_s=0.0) for r in again.index().images()] == before
    assert [d.decision_id for d in again.index().decisions()] == ["d1"]


def test_index_of_another_version_or_other_file_is_rejected(tmp_path):
    with pytest.raises(StoredFileError, match="no such file"):
        ShoreIndex(tmp_path, writable=False)
    (tmp_path / FILE_NAME).write_bytes(b"no database" * 100)
    for writable in (True, False):
        with pytest.raises(StoredFileError, match=r"index\.db"):
            ShoreIndex(tmp_path, writable=writable)


def test_image_is_found_by_name_and_newest_version():
    rows = [row("f1", version=1), row("f2", version=2), row("g", vessel_id="vessel-2", vehicle_id="uuv-2")]
    assert find_image(rows, "uuv-1/AAAA", None, None).name == "f2"
    assert find_image(rows, "uuv-1/AAAA", None, 1).name == "f1"
    assert find_image(rows, "g", None, None).name == "g"
    with pytest.raises(StoredFileError, match="an image that"):
        find_image(rows, "uuv-1/ZZZZ", None, None)
    twice = [*rows, row("h", first_frame_utc_s=9.0)]
    with pytest.raises(StoredFileError, match="one image, with --vessel or by the name of its files"):
        find_image(twice, "uuv-1/AAAA", None, None)


def test_service_removes_counts_and_logs(runner, platform, tmp_path, caplog):
    from sonarpost import keys, wire
    from sonarpost.messages import Relayed
    from sonarpost.services.c2.service import C2Service

    service = runner.start(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out", max_bytes=0)))
    relay = runner.peer("vessel-1", "relay")
    envelope = Relayed(
        vessel_id="vessel-1", key=keys.image_reconstructed("vessel-1"), payload=wire.encode(image()), relayed_utc_s=5.0
    )
    relay.send(keys.shore_inbox("vessel-1"), "c2", envelope)
    eventually(lambda: service.health().counters.get("images_removed") == 1)
    assert service.health().gauges["pictures_bytes"] == 0
    assert images_in(tmp_path / "out") == []
    assert "Image removed by retention" in [record.message for record in caplog.records]
