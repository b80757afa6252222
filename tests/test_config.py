"""Configuration files: errors name file, line and key; environment variables override values."""

import tomllib
from abc import ABC, abstractmethod
from enum import StrEnum
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Annotated

import pytest
from builders.common import REPOSITORY
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field, model_validator

from sonarpost import config
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.errors import ConfigError


class Kind(StrEnum):
    ONE = "one"
    TWO = "two"


class Part(ServiceConfig):
    depth_m: float
    name: str = ""


class PartOfPlugIn(Part):
    extra: int = 0


class Table(ServiceConfig):
    """A table with every kind of key."""

    out_dir: Path = Path("out")
    poll_s: Annotated[float, Field(gt=0, le=60)] = 1.0
    rate: Annotated[int, Field(ge=0, le=6)] = 1
    loud: bool = False
    kind: Kind = Kind.ONE
    names: tuple[str, ...] = ()
    by_address: dict[Annotated[str, Field(pattern="^[0-9]+$")], str] = Field(default_factory=dict)
    airtime_s: dict[int, float] = Field(default_factory=dict)
    part: tuple[Part, ...] = ()
    quiet_dir: Path | None = None

    @model_validator(mode="after")
    def _goes_together(self):
        if self.loud and self.rate == 6:
            raise ValueError("not loud at rate 6")
        return self


class Needy(ServiceConfig):
    port: str


def load(tmp_path, text, model=Table, **environment):
    path = tmp_path / "vessel.toml"
    path.write_text(text, encoding="utf-8")
    return config.load(path, "relay", model, environment)


def error(tmp_path, text, model=Table, **environment):
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text, model, **environment)
    assert "\n" not in str(caught.value)
    return caught.value


PLATFORM = '[platform]\nid = "vessel-1"\n'


def test_every_kind_of_value_is_accepted(tmp_path):
    platform, table = load(
        tmp_path,
        PLATFORM + 'router = ["tcp/a:1", "tcp/b:2"]\nstate_dir = "/x"\nhealth_interval_s = 2\nlog_format = "json"\n'
        '[relay]\nout_dir = "o"\npoll_s = 5\nrate = 6\nkind = "two"\nnames = ["a"]\nby_address = { 3 = "uuv-1" }\n'
        'airtime_s = { 4 = 1, 1 = 2.5 }\n[[relay.part]]\ndepth_m = 1\n[[relay.part]]\ndepth_m = 2.5\nname = "n"\n'
        '[c2]\nother_service = "ignored"\n',
    )
    assert platform == PlatformConfig(
        id="vessel-1", router=("tcp/a:1", "tcp/b:2"), state_dir=Path("/x"), health_interval_s=2.0, log_format="json"
    )
    assert table == Table(
        out_dir=Path("o"),
        poll_s=5.0,
        rate=6,
        kind=Kind.TWO,
        names=("a",),
        by_address={"3": "uuv-1"},
        airtime_s={4: 1.0, 1: 2.5},
        part=(Part(depth_m=1.0), Part(depth_m=2.5, name="n")),
    )


def test_absent_table_has_default_values(tmp_path):
    platform, table = load(tmp_path, PLATFORM)
    assert table == Table()
    assert (platform.router, platform.health_interval_s) == (("tcp/127.0.0.1:7447",), 5.0)


RELAY = PLATFORM + "[relay]\n"
# Invalid configurations: text, line or None, key, part of the message.
INVALID = [
    (PLATFORM + "\n[relais]\nx = 1\n", 4, "relais", "an unknown table', expected platform, modem, atd_"),
    ("# c\nrate = 1\n" + PLATFORM, 2, "rate", "an unknown table"),
    ("relay = 3\n" + PLATFORM, 1, "relay", "got 3, expected a table [relay]"),
    (PLATFORM + "[[relay]]\nrate = 1\n", 3, "relay", "expected a table [relay]"),
    (RELAY + "rate = 1\nrates = 2\n", 5, "relay.rates", "got 'an unknown key', expected one of"),
    ('[platform]\nid = "a"\nnaem = 1\n', 3, "platform.naem", "health_interval_s, id, log_format"),
    (RELAY + 'rate = "1"\n', 4, "relay.rate", "got '1', expected a valid integer"),
    (RELAY + "rate = 7\n", 4, "relay.rate", "got 7, expected less than or equal to 6"),
    (PLATFORM.replace("id", "log_level").replace("vessel-1", "info"), 1, "platform.id", "got 'nothing'"),
    ("[relay]\nrate = 1\n", None, "platform.id", "expected a value"),
    (RELAY + "loud = true\nrate = 6\n", 3, "relay", "not loud at rate 6"),
    (RELAY + 'out_dir = """\nrate = 1\n[c2]\n"""\nrate = 9\n', 8, "relay.rate", "got 9"),
    (RELAY + "out_dir = '''\nrate = 1 \"\"\"\n'''\nrate = 9\n", 7, "relay.rate", "got 9"),
    (PLATFORM + "['relay']\n'rate'=9\n", 4, "relay.rate", "got 9"),
    ("relay.rate = 9\n" + PLATFORM, 1, "relay.rate", "got 9"),
    ('relay . "rate" = 9\n' + PLATFORM, 1, "relay.rate", "got 9"),
    ("relay = { loud = true, rate = 9 }\n" + PLATFORM, 1, "relay.rate", "got 9"),
    (PLATFORM + '\n[relay]\nairtime_s = { 1 = 2, 4 = "x" }\n', 5, "relay.airtime_s.4", "'x'"),
    (RELAY + "rate = 1\n[relay.airtime_s]\n1 = 2\n4 = true\n", 7, "relay.airtime_s.4", "True"),
    (
        PLATFORM + "[[relay.part]]\ndepth_m = 1\n[[relay.part]]\ndepth_m = 'deep'\n",
        6,
        "relay.part.1.depth_m",
        "got 'deep'",
    ),
    (
        PLATFORM + "[[relay.part]]\ndepth_m = 1\n[[relay.part]]\nname = 'n'\n",
        5,
        "relay.part.1.depth_m",
        "got 'nothing'",
    ),
    (
        RELAY + "part = [\n  {depth_m = 1},\n  {depth_m = 1, colour = 2},\n]\n",
        6,
        "relay.part.1.colour",
        "an unknown key",
    ),
    ((PLATFORM + "[relay]\nrate = 9\n").replace("\n", "\r\n"), 4, "relay.rate", "got 9"),
    (RELAY + "rate=9", 4, "relay.rate", "got 9"),
]


@pytest.mark.parametrize(("text", "line", "key", "message"), INVALID)
def test_error_names_file_line_and_key(tmp_path, text, line, key, message):
    caught = error(tmp_path, text)
    where = str(tmp_path / "vessel.toml")
    assert caught.where == (where if line is None else f"{where}:{line}")
    assert caught.field == key
    assert message in str(caught)


def test_error_of_a_table_without_required_or_known_keys(tmp_path):
    caught = error(tmp_path, PLATFORM, Needy)
    assert str(caught) == f"{tmp_path / 'vessel.toml'}: relay.port: got 'nothing', expected a value"
    assert "expected no keys in this table" in str(error(tmp_path, RELAY + "x = 1\n", ServiceConfig))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[platform\n", "at line 1"),
        ("[platform]\nid = \n", "at line 2"),
        ("[platform]\nid = 'a'\nid = 'b'\n", "Cannot overwrite"),
        ("x = " + "9" * 5000, "digits"),
        ("x = " + "[" * 5000, "recursion"),
        ("x = " + "[" * 5000 + "]" * 5000, "recursion"),
        ("\ufeff[platform]\n", "at line 1"),
    ],
)
def test_invalid_toml_is_rejected_with_its_position(tmp_path, text, message):
    caught = error(tmp_path, text)
    assert caught.expected == "valid TOML"
    assert message in str(caught.value)


def test_error_names_an_unreadable_file(tmp_path):
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"[platform]\nid = '\xff'\n")
    for path, message in ((tmp_path / "absent", "No such file"), (tmp_path, "Is a directory"), (binary, "codec")):
        with pytest.raises(ConfigError) as caught:
            config.load(path, "relay", Table, {})
        assert caught.value.where == str(path)
        assert message in str(caught.value)
        assert "a readable TOML file" in str(caught.value)


@pytest.mark.parametrize("added", [(), (ServiceConfig,), (Part, Part), (Part, ServiceConfig), (Part, PartOfPlugIn)])
def test_keys_of_other_models_are_added_to_a_table(added):
    found = config.with_keys(*added)(Table)
    assert {*found.model_fields} == {*Table.model_fields}.union(*(model.model_fields for model in added))
    assert [*found.model_fields][: len(Table.model_fields)] == [*Table.model_fields]


def test_service_of_a_plug_in_takes_no_name(monkeypatch, caplog):
    names = ("c2", "platform", "modem", "all", "own", "own")
    points = [EntryPoint(name, f"package_{number}", "") for number, name in enumerate(names)]
    monkeypatch.setattr(config, "installed_points", lambda _: points)
    found = config.service_packages.__wrapped__()
    assert found == {name: f"sonarpost.services.{name}" for name in config.SERVICES} | {"own": "package_4"}
    assert [record.args[0] for record in caplog.records] == ["c2", "platform", "modem", "all", "own"]


def test_only_a_concrete_class_with_a_model_adds_keys():
    class Base(ABC):
        @abstractmethod
        def run(self): ...

    run = {"run": lambda _: None}
    assert config.adds_keys(type("Whole", (Base,), {**run, "KEYS": Part}), Base)
    for found in (5, Base, Part, type("Abstract", (Base,), {"KEYS": Part})):
        assert not config.adds_keys(found, Base)
    for keys in ({}, {"KEYS": 5}, {"KEYS": dict}):
        assert not config.adds_keys(type("Without", (Base,), {**run, **keys}), Base)


@given(st.text(max_size=60))
def test_arbitrary_text_raises_config_error(tmp_path_factory, text):
    path = tmp_path_factory.getbasetemp() / "any.toml"
    path.write_text(text, encoding="utf-8", newline="")
    with pytest.raises(ConfigError):  # no such text defines the platform
        config.load(path, "relay", Table, {})


# Environment variables


def test_environment_overrides_the_file(tmp_path):
    platform, table = load(
        tmp_path,
        PLATFORM + "[relay]\nrate = 1\nnames = ['a']\nquiet_dir = 'q'\n",
        SONARPOST_PLATFORM__ID="vessel-2",
        SONARPOST_PLATFORM__ROUTER='["tcp/r:7447"]',
        SONARPOST_PLATFORM__STATE_DIR="/var/state",
        SONARPOST_RELAY__RATE="4",
        SONARPOST_RELAY__POLL_S="0.5 # a comment",
        SONARPOST_RELAY__LOUD="true",
        SONARPOST_RELAY__OUT_DIR="'7'",
        SONARPOST_RELAY__KIND="two",
        SONARPOST_RELAY__BY_ADDRESS='{ 3 = "uuv-1" }',
        SONARPOST_C2__OUT_DIR="of another service",
        SONARPOST_DATA="no override",
        SONARPOST_EXIT_WITH_PARENT="1",
        OTHER_RELAY__RATE="9",
        PATH="/bin",
    )
    assert (platform.id, platform.router, platform.state_dir) == ("vessel-2", ("tcp/r:7447",), Path("/var/state"))
    assert isinstance(table, Table)
    assert (table.rate, table.poll_s, table.loud, table.out_dir) == (4, 0.5, True, Path("7"))
    assert (table.kind, table.by_address, table.names) == (Kind.TWO, {"3": "uuv-1"}, ("a",))


def test_environment_can_define_missing_keys(tmp_path):
    platform, table = load(tmp_path, "", Needy, SONARPOST_PLATFORM__ID="v", SONARPOST_RELAY__PORT="/dev/ttyUSB0")
    assert (platform.id, table) == ("v", Needy(port="/dev/ttyUSB0"))


def test_empty_variable_overrides_nothing(tmp_path):
    variables = {"SONARPOST_RELAY__RATE": "", "SONARPOST_PLATFORM__ID": "", "SONARPOST_RELAY__POLL_S": "2.5"}
    platform, table = load(tmp_path, PLATFORM + "[relay]\nrate = 3\n", **variables)
    assert (platform.id, table.rate, table.poll_s) == ("vessel-1", 3, 2.5)
    variables |= {"SONARPOST_PLATFORM__TLS__KEY": "k", "SONARPOST_C2__OUT_DIR": "x", "SONARPOST_IMAGE": "y"}
    assert config.overridden_keys("relay", variables) == ("platform.tls.key", "relay.poll_s")


def test_multi_line_text_is_one_value(tmp_path):
    _, table = load(tmp_path, PLATFORM, Needy, SONARPOST_RELAY__PORT='"a"\nother = 1')
    assert table == Needy(port='"a"\nother = 1')


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("SONARPOST_RELAIS__RATE", "1", "got '1', expected SONARPOST_{platform or a service's name}__{KEY}"),
        ("SONARPOST__RATE", "1", "expected SONARPOST_{"),
        ("SONARPOST_RELAY__", "1", "expected SONARPOST_{"),
        ("SONARPOST_RELAY__RATES", "1", "got 'an unknown key', expected one of: airtime_s"),
        ("SONARPOST_RELAY__RATE", "fast", "got 'fast', expected a valid integer"),
        ("SONARPOST_RELAY__OUT_DIR", "7", "got 7"),
        ("SONARPOST_RELAY__NAMES", "a,b", "got 'a,b', expected a valid array"),
        ("SONARPOST_RELAY__POLL_S", "9" * 5000, "expected a valid number"),
        ("SONARPOST_RELAY__POLL_S", "[" * 5000, "expected a valid number"),
        ("SONARPOST_RELAY__BY_ADDRESS__3", "uuv-1", "got 'an unknown key'"),
    ],
)
def test_error_of_an_override_names_the_variable(tmp_path, name, value, message):
    # The file has the same key with a valid value; the error must not name its line.
    caught = error(tmp_path, PLATFORM + "[relay]\nrate = 1\n", Table, **{name: value})
    assert caught.where == "environment"
    assert caught.field == name
    assert message in str(caught)


# Lines of keys

_keys = st.text(st.sampled_from("ab-_1é \"'\\.#[]{}="), max_size=4)
_values = st.recursive(
    st.integers() | st.booleans() | st.text(max_size=6),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(_keys, inner, max_size=3),
    max_leaves=8,
)


def quoted(text):
    return '"' + "".join(c if c.isalnum() and c.isascii() else f"\\U{ord(c):08x}" for c in text) + '"'


class Writer:
    """Writes a document and records the line of each key."""

    def __init__(self, draw):
        self.draw, self.text = draw, ""
        self.lines: dict[tuple[str, ...], int] = {}

    def note(self, path):
        self.lines[path] = self.text.count("\n") + 1

    def filler(self, *choices):
        self.text += self.draw(st.sampled_from(choices))

    def value(self, path, value):
        if isinstance(value, dict):
            self.text += "{"
            for number, (key, inner) in enumerate(value.items()):
                self.text += ", " if number else " "
                self.note((*path, key))
                self.text += quoted(key) + " = "
                self.value((*path, key), inner)
            self.text += " }"
        elif isinstance(value, list):
            self.text += "["
            for number, inner in enumerate(value):
                if len(path) == 2:
                    self.filler("", "\n", " # ] x = 1\n", "\n\n ")
                self.note((*path, str(number)))
                self.value((*path, str(number)), inner)
                self.text += ","
            self.text += "]"
        elif isinstance(value, str):
            long = f'"""\n{quoted(value)[1:-1]}\\\n  """'
            self.text += self.draw(st.sampled_from([quoted(value), long])) if len(path) == 2 else quoted(value)
        else:
            self.text += str(value).lower()


@given(st.data())
def test_line_of_every_key_of_an_arbitrary_document(data):
    tables = data.draw(st.dictionaries(_keys, st.dictionaries(_keys, _values, max_size=3), max_size=3))
    writer = Writer(data.draw)
    for name, table in tables.items():
        writer.filler("", "\n", "# [x]\n", " \n")
        writer.note((name,))
        writer.text += f"[{quoted(name)}]\n"
        for key, value in table.items():
            writer.filler("", "\n", "  # y = 2\n", "\t")
            writer.note((name, key))
            writer.text += quoted(key) + "="
            writer.value((name, key), value)
            writer.filler("\n", " # c\n", "\n\n")
    assert tomllib.loads(writer.text).keys() == tables.keys()
    assert config.key_lines(writer.text) == writer.lines


@pytest.mark.parametrize("name", ["uuv", "vessel", "shore"])
def test_line_of_every_key_of_the_example_files(name):
    text = (REPOSITORY / "config" / f"{name}.toml").read_text(encoding="utf-8")
    lines = config.key_lines(text)
    for table, keys in tomllib.loads(text).items():
        for key in keys:
            line = text.splitlines()[lines[table, key] - 1]
            assert line.startswith(f"{key} =")


class Nothing(ServiceConfig):
    """No keys."""


def test_modem_table_belongs_to_the_platform(tmp_path):
    file = tmp_path / "vessel.toml"
    file.write_text('[platform]\nid = "vessel-1"\n[modem]\ndriver = "other"\n[relay]\n')
    platform, _ = config.load(file, "relay", Nothing, {})
    assert platform.modem.driver == "other"
    platform, _ = config.load(file, "relay", Nothing, {"SONARPOST_MODEM__DRIVER": "third"})
    assert platform.modem.driver == "third"
    file.write_text('[platform]\nid = "vessel-1"\n[modem]\ndrivers = "other"\n[relay]\n')
    with pytest.raises(ConfigError, match=r"vessel.toml:4: modem.drivers: .*expected one of: driver"):
        config.load(file, "relay", Nothing, {})
