"""Files of reconstructed images: three consistent files with reproducible bytes."""

import errno
import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pytest
from builders.record_samples import COMPLETE_IMAGE, DAMAGED_IMAGE
from builders.record_strategies import images
from hypothesis import given

from sonarpost.archive.image_files import image_file_name, stored_image, write_image
from sonarpost.errors import StoredFileError
from sonarpost.export.contacts import side_car
from sonarpost.messages import Pixels, ReconstructedImage
from sonarpost.sonar.image_files import read_image

NAME = "uuv-1_20161012T090001Z_00A7_v1"


def with_pixels(pixels, **more):
    stored = Pixels.from_array(pixels)
    fields = COMPLETE_IMAGE.model_dump() | {"pixels": stored, "pixels_sha256": stored.sha256} | more
    return ReconstructedImage(**fields)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_name_holds_vehicle_time_image_and_version():
    assert image_file_name(COMPLETE_IMAGE) == NAME
    assert image_file_name(DAMAGED_IMAGE) == "uuv-1_20161012T090001Z_00A7_v2"
    for at_s, time in ((0.0, "19700101T000000Z"), (253402300799.0, "99991231T235959Z")):
        assert image_file_name(with_pixels(np.zeros((1, 1), np.uint8), first_frame_utc_s=at_s)).split("_")[1] == time


def test_image_is_three_consistent_files(tmp_path):
    tiff, new, _ = write_image(tmp_path / "a" / "b", COMPLETE_IMAGE)
    assert new
    assert tiff == tmp_path / "a" / "b" / f"{NAME}.tiff"
    assert sorted(contents(tiff.parent)) == [f"{NAME}.json", f"{NAME}.png", f"{NAME}.tiff"]
    for suffix in (".tiff", ".png"):
        np.testing.assert_array_equal(read_image(tiff.with_suffix(suffix)), COMPLETE_IMAGE.pixels.to_array())
    stored = json.loads(tiff.with_suffix(".json").read_text())
    assert stored == json.loads(json.dumps(side_car(COMPLETE_IMAGE)))
    assert stored["contact"]["lat_deg"] == 41.5251
    assert (stored["height_px"], stored["width_px"], stored["bits"]) == (2, 3, 8)
    assert (stored["type"], stored["v"], stored["image_id"], stored["complete"]) == (
        "reconstructed_image",
        1,
        "00A7",
        True,
    )
    assert "pixels" not in stored


def test_tiff_and_png_hold_16_bits(tmp_path):
    pixels = np.array([[0, 255, 256], [40_000, 65_535, 1]], np.uint16)
    tiff, _, _ = write_image(tmp_path, with_pixels(pixels))
    for suffix in (".tiff", ".png"):
        back = read_image(tiff.with_suffix(suffix))
        assert back.dtype == np.uint16
        np.testing.assert_array_equal(back, pixels)


@given(images())
def test_stored_image_is_the_record_that_was_written(tmp_path_factory, image):
    tiff, _, _ = write_image(tmp_path_factory.mktemp("out"), image)
    assert stored_image(tiff.with_suffix(".json").read_bytes(), read_image(tiff), "stored") == image


def test_damaged_files_are_named(tmp_path):
    tiff, _, _ = write_image(tmp_path, DAMAGED_IMAGE)
    content, pixels = tiff.with_suffix(".json").read_bytes(), read_image(tiff)
    runs = b"AKg="  # once the byte a8
    assert DAMAGED_IMAGE.missing_mask == b"\xa8"
    assert runs in content
    for replaced, other, expected in (
        (content[:-9], pixels, "a.json: got "),
        (content.replace(runs, b"?"), pixels, "a.json: missing_runs: got '\\?', expected the mask"),
        (content.replace(runs, b"AAAA"), pixels, "a.json: missing_runs: got 'AAAA', expected the mask"),
        (content.replace(runs, b"/6g="), pixels, "a.json: missing_runs: got .*runs of 1 bytes, not 256"),
        (content, pixels + 1, "a.json: pixels_sha256: got "),
    ):
        with pytest.raises(StoredFileError, match=expected):
            stored_image(replaced, other, "a.json")


@given(images())
def test_files_are_written_once_and_reproducible(tmp_path_factory, image):
    here, there = tmp_path_factory.mktemp("vessel"), tmp_path_factory.mktemp("shore")
    tiff, new, _ = write_image(here, image)
    assert new
    np.testing.assert_array_equal(read_image(tiff), image.pixels.to_array())
    write_image(there, image)
    assert contents(here) == contents(there)
    before = {path.name: path.stat().st_mtime_ns for path in here.iterdir()}
    assert write_image(here, image) == (tiff, False, False)
    assert {path.name: path.stat().st_mtime_ns for path in here.iterdir()} == before


def test_versions_do_not_replace_each_other(tmp_path):
    write_image(tmp_path, COMPLETE_IMAGE)
    kept = contents(tmp_path)
    write_image(tmp_path, DAMAGED_IMAGE)
    now = contents(tmp_path)
    assert len(now) == 6
    assert kept.items() <= now.items()


def test_damaged_files_are_written_again(tmp_path):
    tiff, _, _ = write_image(tmp_path, COMPLETE_IMAGE)
    whole = contents(tmp_path)
    for damage in (
        lambda: tiff.with_suffix(".json").unlink(),
        lambda: tiff.with_suffix(".json").write_bytes(b"\xff{"),
        tiff.unlink,
    ):
        damage()
        assert write_image(tmp_path, COMPLETE_IMAGE) == (tiff, True, False)
        assert contents(tmp_path) == whole


@pytest.mark.parametrize("after", [0, 1, 2, 3])
def test_full_disk_leaves_no_side_car_without_its_image(after, tmp_path, monkeypatch):
    """The disk accepts `after` of the three files; with 3 it rejects their folder."""
    synced = 0
    fsync = os.fsync

    def full(descriptor):
        nonlocal synced
        synced += 1
        if synced > after:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        write_image(tmp_path, COMPLETE_IMAGE)
    monkeypatch.undo()
    assert sorted(contents(tmp_path)) == ([f"{NAME}.png", f"{NAME}.tiff"] if after == 3 else [])
    assert not (tmp_path / f"{NAME}.json").exists()
    assert write_image(tmp_path, COMPLETE_IMAGE)[1]
    assert len(contents(tmp_path)) == 3


def test_side_car_is_written_last(tmp_path, monkeypatch):
    order = []
    replace = Path.replace

    def rename(self, target):
        order.append(Path(target).suffix)
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", rename)
    write_image(tmp_path, COMPLETE_IMAGE)
    assert order[-1] == ".json"
    assert sorted(order) == [".json", ".png", ".tiff"]


def shifted(seconds, value=7):
    """Return another image whose first frame arrived within the same second."""
    return with_pixels(np.full((2, 3), value, np.uint8), first_frame_utc_s=COMPLETE_IMAGE.first_frame_utc_s + seconds)


def test_other_image_of_the_same_name_is_kept(tmp_path):
    first, second, third = COMPLETE_IMAGE, shifted(0.4), shifted(0.4, value=8)
    assert image_file_name(first) == image_file_name(second)
    assert write_image(tmp_path, first) == (tmp_path / f"{NAME}.tiff", True, False)
    stored = contents(tmp_path)
    written = [write_image(tmp_path, image) for image in (second, third)]
    assert all(found.is_new and found.is_conflict for found in written)
    assert len({found.tiff for found in written}) == 2
    for found, image in zip(written, (second, third), strict=True):
        digest = hashlib.sha256(found.tiff.with_suffix(".json").read_bytes()).hexdigest()[:16]
        assert found.tiff.name == f"{NAME}_{digest}.tiff"
        np.testing.assert_array_equal(read_image(found.tiff), image.pixels.to_array())
    now = contents(tmp_path)
    assert len(now) == 9
    assert stored.items() <= now.items()
    # Repeated images change no file.
    for found, image in zip(written, (second, third), strict=True):
        assert write_image(tmp_path, image) == (found.tiff, False, True)
    assert write_image(tmp_path, first) == (tmp_path / f"{NAME}.tiff", False, False)
    assert contents(tmp_path) == now
