"""Logs: one line an event, whatever the event holds."""

from __future__ import annotations

import json
import logging
import math
import re
from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import logs
from sonarpost.logs import JsonFormatter, TextFormatter, kv


def record(message: str = "Picture stored", /, *args: object, **fields: object) -> logging.LogRecord:
    made = logging.LogRecord("n", logging.WARNING, "f.py", 1, message, args, None)
    made.created = 1476262800.25
    vars(made).update(kv(**fields))
    return made


def text(*args: object, **fields: object) -> str:
    return TextFormatter("relay").format(record(*args, **fields))  # type: ignore[arg-type]


def event(*args: object, **fields: object) -> dict[str, object]:
    line = JsonFormatter("relay").format(record(*args, **fields))  # type: ignore[arg-type]
    assert "\n" not in line

    def no_constant(name: str) -> None:
        raise AssertionError(f"{name} is no JSON")

    return dict(json.loads(line, parse_constant=no_constant))


def test_a_line_for_people() -> None:
    assert (
        text(image_id="0001", bytes=232)
        == "2016-10-12T09:00:00.250Z WARNING relay: Picture stored image_id=0001 bytes=232"
    )
    assert text("Took %d of %s", 2, "3") == "2016-10-12T09:00:00.250Z WARNING relay: Took 2 of 3"


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ("", '""'),
        ("plain", "plain"),
        ("two words", '"two words"'),
        ("a=b", '"a=b"'),
        ('say "x"', '"say \\"x\\""'),
        ("it's", '"it\'s"'),
        ("line\nline", '"line\\nline"'),
        ("\x1b[2J", '"\\u001b[2J"'),
        ("a\u2028b", '"a\\u2028b"'),
        ("a\x85b", '"a\\u0085b"'),
        ("größe", "größe"),
        (1.0, "1"),
        (0.123456789, "0.123457"),
        (math.nan, "nan"),
        (True, "True"),
        (None, "None"),
        (7, "7"),
        ((1, 2), '"(1, 2)"'),
        (b"\xff\n", "\"b'\\\\xff\\\\n'\""),
    ],
)
def test_a_value_for_people(value: object, shown: str) -> None:
    assert text(x=value).endswith(f" x={shown}")


def test_an_event_for_machines() -> None:
    assert event(image_id="0001", ratio=0.5, missing=None) == {
        "time": "2016-10-12T09:00:00.250Z",
        "level": "warning",
        "service": "relay",
        "message": "Picture stored",
        "image_id": "0001",
        "ratio": 0.5,
        "missing": None,
    }


def test_what_json_has_no_type_for_is_text() -> None:
    got = event(a=math.nan, b=-math.inf, c=b"x", d={1}, e=[math.nan], f=[1, "a"])
    assert [got[name] for name in "abcdef"] == ["nan", "-inf", "b'x'", "{1}", "[nan]", [1, "a"]]


def test_a_field_does_not_take_the_place_of_time_or_level() -> None:
    got = event(time=1, level="x", service="y", message="z")
    assert (got["level"], got["service"], got["message"]) == ("warning", "relay", "Picture stored")
    assert (got["time_"], got["level_"], got["service_"], got["message_"]) == (1, "x", "y", "z")


@given(st.text(), st.text() | st.floats() | st.integers() | st.binary())
def test_any_event_is_one_printable_line(message: str, value: object) -> None:
    made = record("%s", message, x=value)
    line = TextFormatter("relay").format(made)
    assert line.isprintable()
    assert re.match(r"2016-10-12T09:00:00\.250Z WARNING relay: ", line)
    parsed = json.loads(JsonFormatter("relay").format(made))
    assert parsed["message"] == message


def with_exception() -> logging.LogRecord:
    try:
        int("two\nlines")
    except ValueError as error:
        made = record()
        made.exc_info = (type(error), error, error.__traceback__)
    return made


def test_a_traceback_follows_in_text_and_is_a_field_in_json() -> None:
    made = with_exception()
    lines = TextFormatter("relay").format(made).splitlines()
    assert lines[0].endswith("Picture stored")
    assert lines[1].startswith("Traceback")
    assert lines[-1].startswith("ValueError: invalid literal")
    line = JsonFormatter("relay").format(made)
    assert "\n" not in line
    assert "ValueError: invalid literal" in json.loads(line)["traceback"]


@pytest.mark.parametrize("nothing", [None, False, ()])
def test_no_exception_is_no_traceback(nothing: object) -> None:
    made = record()
    made.exc_info = nothing  # type: ignore[assignment]  # what logging leaves there for exc_info=False
    assert TextFormatter("relay").format(made).endswith("Picture stored")
    assert "traceback" not in json.loads(JsonFormatter("relay").format(made))


@pytest.fixture
def clean_root() -> Iterator[logging.Logger]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield root
    root.handlers[:] = handlers
    root.setLevel(level)


def test_logs_go_to_standard_error_in_the_chosen_form(
    clean_root: logging.Logger, capsys: pytest.CaptureFixture[str]
) -> None:
    logs.set_up("relay", "warning", "json")
    logging.getLogger("a.b").info("Not shown")
    logging.getLogger("a.b").warning("Shown", extra=kv(n=1))
    logs.set_up("c2", "debug")
    logging.getLogger("a.b").debug("Shown too", exc_info=False)
    out, err = capsys.readouterr()
    assert out == ""
    first, second = err.splitlines()
    assert (json.loads(first)["message"], json.loads(first)["n"]) == ("Shown", 1)
    assert second.endswith("DEBUG c2: Shown too")
    assert len(clean_root.handlers) == 1


def test_what_a_line_concerns_is_in_both_formats() -> None:
    with logs.log_context(vehicle="uuv-1", image_id=None):
        with logs.log_context(image_id="00A7"):
            assert text("Sent", bytes=3).endswith(": Sent vehicle=uuv-1 image_id=00A7 bytes=3")
            assert event("Sent", image_id="00A8")["image_id"] == "00A8"  # the call knows better
        assert text("Sent").endswith(": Sent vehicle=uuv-1")
    assert text("Sent").endswith(": Sent")


def test_what_a_line_concerns_ends_with_an_error() -> None:
    with pytest.raises(ValueError, match="x"), logs.log_context(vehicle="uuv-1"):
        raise ValueError("x")
    assert text("Sent").endswith(": Sent")


def test_what_a_line_concerns_is_looked_for_once_and_only_for_a_line() -> None:
    looked = 0

    def find() -> dict[str, object]:
        nonlocal looked
        looked += 1
        return {"image_id": "00A7", "contact_id": None}

    with logs.log_context(vehicle="uuv-1"), logs.lazy_log_context(find):
        assert looked == 0
        assert text("Sent").endswith(": Sent vehicle=uuv-1 image_id=00A7")
        with logs.log_context(step=2):
            assert event("Sent")["step"] == 2
        assert looked == 1
    assert text("Sent").endswith(": Sent")
    with logs.lazy_log_context(find):
        pass
    assert looked == 1
