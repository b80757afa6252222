"""Retention of files in a folder."""

import os

from builders.records import reconstructed_image

from sonarpost.archive.image_files import remove_old_images, write_image
from sonarpost.archive.retention import remove_files
from sonarpost.messages import Pixels

DAY_S = 86400.0
NOW_UTC_S = 1_800_000_000.0


def image(image_id, version=1):
    picture = Pixels(height_px=20, width_px=30, bits=8, data=bytes([version]) * 600)
    return reconstructed_image(picture, image_id=image_id, version=version)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def set_age(folder, name, age_s):
    for path in folder.glob(f"{name}.*"):
        os.utime(path, (NOW_UTC_S - age_s, NOW_UTC_S - age_s))


def test_files_of_one_name_are_removed_together_by_age(tmp_path):
    for name, age_s in (("old", 11 * DAY_S), ("new", 9 * DAY_S)):
        (tmp_path / f"{name}.tiff").write_bytes(b"12345")
        (tmp_path / f"{name}.txt").write_bytes(b"123")
        set_age(tmp_path, name, age_s)
    (tmp_path / "other.dat").write_bytes(b"not of this service")
    set_age(tmp_path, "other", 99 * DAY_S)
    assert remove_files(tmp_path, (".txt", ".tiff"), NOW_UTC_S, 10.0, None) == ["old"]
    assert names(tmp_path) == ["new.tiff", "new.txt", "other.dat"]


def test_files_stored_while_the_clock_was_not_set_are_not_removed_by_age(tmp_path):
    (tmp_path / "unset.tiff").write_bytes(b"12345")
    os.utime(tmp_path / "unset.tiff", (100.0, 100.0))
    assert remove_files(tmp_path, (".tiff",), NOW_UTC_S, 10.0, None) == []
    assert remove_files(tmp_path, (".tiff",), NOW_UTC_S, 10.0, 4) == ["unset"]


def test_oldest_files_are_removed_above_the_maximum_size(tmp_path):
    for number in range(4):
        (tmp_path / f"{number}.tiff").write_bytes(b"x" * 100)
        set_age(tmp_path, number, -number)
    assert remove_files(tmp_path, (".tiff",), NOW_UTC_S, 10.0, 250) == ["0", "1"]
    assert names(tmp_path) == ["2.tiff", "3.tiff"]


def test_absent_folder_has_no_files(tmp_path):
    assert remove_files(tmp_path / "absent", (".tiff",), NOW_UTC_S, 1.0, 0) == []


def test_superseded_versions_of_images_are_removed_first(tmp_path):
    stems = []
    for age_s, each in ((30, image("AAAA")), (20, image("BBBB", 1)), (10, image("BBBB", 2))):
        write_image(tmp_path, each)
        stems.append(next(path.stem for path in tmp_path.glob(f"*{each.image_id}_v{each.version}.tiff")))
        set_age(tmp_path, stems[-1], age_s)
    one_less = sum(path.stat().st_size for path in tmp_path.iterdir()) - 1
    assert remove_old_images(tmp_path, NOW_UTC_S, 10.0, one_less) == [stems[1]]
    assert remove_old_images(tmp_path, NOW_UTC_S, 10.0, 0) == [stems[0], stems[2]]
