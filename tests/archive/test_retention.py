"""Retention of files in a folder."""

import os

from builders.records import reconstructed_image
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.archive.image_files import remove_old_images, write_image
from sonarpost.archive.retention import Stored, remove_files, select_for_removal
from sonarpost.messages import Pixels

DAY_S = 86400.0
NOW_UTC_S = 1_800_000_000.0


def image(image_id, version=1):
    pixels = Pixels(height_px=20, width_px=30, bits=8, data=bytes([version]) * 600)
    return reconstructed_image(pixels, image_id=image_id, version=version)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def set_age(folder, name, age_s):
    for path in folder.glob(f"{name}.*"):
        os.utime(path, (NOW_UTC_S - age_s, NOW_UTC_S - age_s))


def test_files_of_one_name_are_removed_together_by_age(tmp_path):
    for name, age_s in (("old", 11 * DAY_S), ("new", 0.0)):
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


def test_clock_that_is_ahead_makes_no_item_old():
    items = [Stored(day, NOW_UTC_S + day * DAY_S, 1) for day in range(12)]
    for ahead_days in (0.0, 400.0, 1e6):
        assert select_for_removal(items, NOW_UTC_S + (11.0 + ahead_days) * DAY_S, 10.0, None) == [0]
    assert select_for_removal(items, 0.0, 10.0, None) == []


@given(
    st.lists(st.tuples(st.sampled_from("abcd"), st.integers(0, 50), st.integers(0, 3)), max_size=40),
    st.integers(0, 500),
)
def test_source_loses_nothing_while_it_has_no_more_than_its_share(items, max_bytes):
    stored = [Stored(number, float(number), size, order, of) for number, (of, size, order) in enumerate(items)]
    removed = set(select_for_removal(stored, NOW_UTC_S, None, max_bytes))
    largest_item = max((size for _, size, _ in items), default=0)
    left = {
        of: sum(each.size_bytes for each in stored if each.source == of and each.item not in removed) for of in "abcd"
    }
    assert sum(left.values()) <= max_bytes
    for each in stored:
        if each.item in removed:
            # It came from the largest source at that time, so that no other one has more than it had.
            assert max(left.values()) <= left[each.source] + largest_item
            same = [other for other in stored if other.source == each.source and other.item not in removed]
            assert all((other.order, other.item) > (each.order, each.item) for other in same)


def test_vehicle_that_floods_displaces_no_image_of_another(tmp_path):
    def store(vehicle, number, age_s):
        each = image(f"{number:04d}").model_copy(update={"vehicle_id": vehicle})
        name = write_image(tmp_path, each).tiff.stem
        set_age(tmp_path, name, age_s)

    for number in range(5):
        store("uuv-1", number, 100.0 - number)
    one_bytes = sum(path.stat().st_size for path in tmp_path.iterdir()) // 5
    for number in range(20):  # by forged addresses, which are one source
        store(f"modem-{100 + number}", number, 50.0 - number)
    remove_old_images(tmp_path, NOW_UTC_S, 10.0, 12 * one_bytes)
    assert len(list(tmp_path.glob("uuv-1_*.tiff"))) == 5
    assert 6 <= len(list(tmp_path.glob("modem-*.tiff"))) <= 7


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
