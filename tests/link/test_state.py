"""Saved parts: dataclasses become msgpack and come back; anything malformed is a FrameError that names the field."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Annotated

import msgpack
import numpy as np
import pytest

from sonarpost.errors import FrameError
from sonarpost.link.coding.byte_ranges import PartialBytes
from sonarpost.link.state import (
    FORMAT_VERSION,
    PROGRESS,
    SEPARATE,
    Bounds,
    PartReader,
    SavedParts,
    below,
    from_plain,
    pack_part,
    prefixed,
    unpack_plain,
)


class Colour(Enum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Inner:
    percent: Annotated[int, Bounds(0, 100)]
    name: str = "none"


@dataclass
class Sample:
    number: int
    values: dict[int, tuple[float, float]]
    inner: Inner | None
    colours: list[Colour]
    curve: np.ndarray[tuple[int], np.dtype[np.float64]]
    text: PartialBytes
    flag: bool = False
    sent: int = field(default=0, metadata=PROGRESS)
    cache: object = field(default=None, metadata=SEPARATE)


def sample(number: int = 7, sent: int = 3) -> Sample:
    text = PartialBytes()
    text.write(2, b"abc")
    curve = np.array([1.0, 0.5])
    return Sample(number, {1: (2.0, 3.5)}, Inner(40, "x"), [Colour.BLUE], curve, text, flag=True, sent=sent)


def plain(**changes: object) -> list[object]:
    """Return the plain form of a sample, with other values of some fields."""
    names = ("number", "values", "inner", "colours", "curve", "text", "flag")
    values = dict(zip(names, msgpack.unpackb(pack_part(sample()), strict_map_key=False)[1:], strict=True)) | changes
    return list(values.values())


def test_all_kinds_of_fields_survive_a_round_trip() -> None:
    reader = PartReader({"item/7": pack_part(sample()), "progress/7": pack_part(sample(), "progress")}, "test state")
    (found,) = reader.read_group("item", Sample, progress="progress")
    assert reader.errors == {}
    assert (found.number, found.values, found.inner) == (7, {1: (2.0, 3.5)}, Inner(40, "x"))
    assert found.colours == [Colour.BLUE]
    assert np.array_equal(found.curve, [1.0, 0.5])
    assert (bytes(found.text.data), found.text.received) == (b"\0\0abc", ((2, 5),))
    assert (found.flag, found.sent, found.cache) == (True, 3, None)


def test_a_missing_value_at_the_end_has_its_default() -> None:
    assert from_plain(Sample, plain()[:-1], "test state").flag is False


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"number": "7"}, "number: got '7', expected int"),
        ({"number": True}, "number: got True, expected int"),
        ({"values": []}, "values: got [], expected a map"),
        ({"values": {"1": [1.0, 2.0]}}, "values: got '1', expected int"),
        ({"values": {1: [1.0]}}, "values[1]: got [1.0], expected a list of 2"),
        ({"values": {1: [1.0, float("nan")]}}, "values[1][1]: got nan, expected a finite number"),
        ({"inner": 5}, "inner: got 5, expected a list of fields"),
        ({"inner": []}, "inner.percent: got 'nothing', expected a value"),
        ({"inner": [101]}, "inner.percent: got 101, expected 0..100"),
        ({"inner": [1, "x", 2]}, "inner: got '3 fields', expected at most 2"),
        ({"colours": "red"}, "colours: got 'red', expected a list"),
        ({"colours": ["red", "green"]}, "colours[1]: got 'green', expected red, blue"),
        ({"curve": b"1234567"}, "curve: got b'1234567', expected bytes of float64 values"),
        ({"curve": np.array([np.inf]).tobytes()}, "curve: got 'not finite', expected finite values"),
        ({"text": "abc"}, "text: got 'abc', expected bytes"),
        ({"flag": 1}, "flag: got 1, expected bool"),
    ],
)
def test_error_names_the_invalid_field(change: dict[str, object], named: str) -> None:
    with pytest.raises(FrameError) as raised:
        from_plain(Sample, plain(**change), "test state")
    assert str(raised.value) == f"test state: {named}"


@pytest.mark.parametrize("change", [{"text": b"\xc1"}, {"text": msgpack.packb([5, [[4, b"ab"]]])}])
def test_error_of_a_nested_value_names_the_field(change: dict[str, object]) -> None:
    with pytest.raises(FrameError, match=r"^test state: text"):
        from_plain(Sample, plain(**change), "test state")


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"", "msgpack"),
        (b"\xc1", "msgpack"),
        (msgpack.packb({"a": 1}), "a list"),
        (msgpack.packb([]), "format version"),
        (msgpack.packb([True, *plain()]), "format version"),
        (msgpack.packb([FORMAT_VERSION + 1, *plain()]), "format version"),
        (msgpack.packb([FORMAT_VERSION - 1, *plain()]), "format version: got 1, expected 2"),
        (msgpack.packb([FORMAT_VERSION, *plain(), 1]), "at most 7"),
    ],
)
def test_an_unreadable_part_is_reported_and_skipped(data: bytes, expected: str) -> None:
    reader = PartReader({"item/1": data, "item/2": pack_part(sample(2))}, "test state")
    assert [found.number for found in reader.read_group("item", Sample)] == [2]
    assert list(reader.errors) == ["item/1"]
    assert expected in str(reader.errors["item/1"])
    assert reader.errors["item/1"].where == "test state: item/1"


@pytest.mark.parametrize("progress", [None, b"\xc1", msgpack.packb([FORMAT_VERSION, "3"])])
def test_an_unreadable_progress_part_leaves_the_defaults(progress: bytes | None) -> None:
    parts = {"item/1": pack_part(sample())} | ({} if progress is None else {"progress/1": progress})
    reader = PartReader(parts, "test state")
    (found,) = reader.read_group("item", Sample, progress="progress")
    assert (found.number, found.sent) == (7, 0)
    assert list(reader.errors) == ([] if progress is None else ["progress/1"])


def test_an_unreadable_part_with_readable_progress_is_reported_once() -> None:
    parts = {"item/1": b"\xc1", "progress/1": pack_part(sample(), "progress")}
    reader = PartReader(parts, "test state")
    assert reader.read_group("item", Sample, progress="progress") == []
    assert list(reader.errors) == ["item/1"]


def test_apply_can_reject_a_part() -> None:
    def reject_large(found: Sample) -> None:
        if found.number > 5:
            raise FrameError("image", "number", found.number, "at most 5")

    reader = PartReader({"item/1": pack_part(sample(1)), "item/9": pack_part(sample(9))}, "test state")
    assert [found.number for found in reader.read_group("item", Sample, apply=reject_large)] == [1]
    assert str(reader.errors["item/9"]) == "test state: item/9: number: got 9, expected at most 5"


def test_reader_finds_single_parts_and_groups() -> None:
    data = pack_part(Inner(1))
    reader = PartReader({"head": data, "image/3/1": data, "image/3/2": data, "image/12/1": data}, "test state")
    assert "head" in reader
    assert "tail" not in reader
    assert reader.read("head", Inner) == Inner(1)
    assert reader.read("tail", Inner) is None
    assert len(reader.read_group("image", Inner)) == 3
    assert len(reader.read_group("image/3", Inner)) == 2
    assert reader.read_group("image/1", Inner) == []
    assert reader.read_group("block", Inner) == []


def test_saved_parts_returns_only_the_changes() -> None:
    saved = SavedParts({"a": b"1", "b": b"2"})
    parts = {"a": b"1", "c": b"3"}
    assert saved.changes(parts) == {"b": None, "c": b"3"}
    assert saved.changes(parts) == {"b": None, "c": b"3"}, "not yet on the disk"
    saved.commit(parts)
    assert saved.changes(parts) == {}
    assert saved.changes(parts | {"a": b"4"}) == {"a": b"4"}


def test_prefixes_are_added_and_removed() -> None:
    parts = {"a": b"1", "b/c": b"2"}
    assert prefixed("x/", parts) == {"x/a": b"1", "x/b/c": b"2"}
    assert below("x/", prefixed("x/", parts) | {"y/a": b"3"}) == parts


def test_unpack_plain_rejects_another_type() -> None:
    assert unpack_plain(dict, msgpack.packb({1: 2}), "test state") == {1: 2}
    with pytest.raises(FrameError, match="expected a dict"):
        unpack_plain(dict, msgpack.packb([1]), "test state")


def test_a_class_without_fields_cannot_be_saved() -> None:
    with pytest.raises(TypeError, match="object cannot be saved"):
        pack_part(object())
