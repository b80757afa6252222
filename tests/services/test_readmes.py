"""The page of each service says what the code does: configuration, keys, records, counters, gauges; nothing stale."""

from __future__ import annotations

import ast
import importlib
import inspect
import re
import tomllib

import pytest
from builders.common import REPOSITORY
from pydantic import TypeAdapter
from pydantic_core import PydanticUndefined

from sonarpost import keys, messages
from sonarpost.messages import Record
from sonarpost.runtime.modem_service import ModemServiceConfig

SERVICES = {
    "atd_stub": ("AtdStubService", "AtdStubConfig", "uuv"),
    "compressor": ("CompressorService", "CompressorConfig", "uuv"),
    "uuv_modem": ("UuvModemService", "UuvModemConfig", "uuv"),
    "op_modem": ("OpModemService", "OpModemConfig", "vessel"),
    "decompressor": ("DecompressorService", "DecompressorConfig", "vessel"),
    "relay": ("RelayService", "RelayConfig", "vessel"),
    "c2": ("C2Service", "C2Config", "shore"),
    "console": ("ConsoleService", "ConsoleConfig", "vessel"),
}
# c2 compares these with what it finds inside an envelope; it neither subscribes to them nor publishes on them.
ONLY_COMPARED = {
    "op_modem": {keys.command("x", "x")},
    "c2": {
        keys.image_reconstructed("x"),
        keys.contact_decision("x"),
        keys.shore_inbox("x", "x"),
        keys.command_all("x"),
    },
    "relay": {keys.command("x", "x")},
    # It listens to them, where they are published.
    "atd_stub": {keys.health("x", "x"), keys.acoustic_queue("x")},
    # It subscribes to two kinds, each by its name.
    "compressor": {keys.command("x", "x")},
    # It watches these, and what it takes ashore is in the text below the table.
    "console": {
        keys.acoustic_rx("x"),
        keys.acoustic_downlink("x"),
        keys.acoustic_queue_everywhere(),
        keys.health_everywhere(),
        keys.health_all("x"),
        keys.health("x", "x"),
        keys.tasking_state_all("x"),
        keys.shore_image_all("x"),
        keys.shore_image("x", "x"),
        keys.shore_decision_all("x"),
        keys.shore_decision("x", "x"),
    },
}
# Counters whose names are put together from others.
COMPOSED_COUNTERS = {"relay": {"reconstructed_images_relayed", "decisions_relayed"}}
BASE_GAUGES = {"inbox", "outbox", "refused", "disk_free_bytes"}
RUNTIME = REPOSITORY / "common" / "sonarpost" / "runtime"


class Page:
    """A service's README, cut at its headings into tables of cells."""

    def __init__(self, name: str) -> None:
        self.text = (REPOSITORY / "services" / name / "README.md").read_text(encoding="utf-8")

    def rows(self, heading: str) -> list[list[str]]:
        section = re.split(r"^## ", self.text, flags=re.MULTILINE)
        [body] = [part for part in section if part.startswith(f"{heading}\n")]
        lines = [line.strip()[1:-1].split("|") for line in body.splitlines() if line.startswith("|")]
        cells = [[cell.strip() for cell in line] for line in lines]
        return [row for row in cells if row[0] and not set("".join(row)) <= set("-| ")]

    def key_rows(self) -> list[list[str]]:
        return [row for row in self.rows("Zenoh keys") if row[0] in ("in", "out")]


def quoted(cell: str) -> list[str]:
    return re.findall(r"`([^`]*)`", cell)


def filled(key: str) -> str:
    return re.sub(r"\{\w+\}", "x", key)


def trees(name: str) -> list[ast.AST]:
    return [ast.parse(p.read_text(encoding="utf-8")) for p in sorted((REPOSITORY / "services" / name).glob("*.py"))]


def calls(tree: ast.AST) -> list[ast.Call]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)]


def keys_in_code(name: str) -> set[str]:
    """Every key expression the service's code makes, its arguments replaced by x."""
    found = set()
    for tree in trees(name):
        for call in calls(tree):
            if isinstance(call.func.value, ast.Name) and call.func.value.id == "keys":
                function = getattr(keys, call.func.attr)
                if "key" not in inspect.signature(function).parameters:
                    found.add(function(*["x"] * len(call.args)))
    return found


def counters_in_code(sources: list[ast.AST]) -> set[str]:
    found = set()
    for tree in sources:
        for call in calls(tree):
            if call.func.attr == "count" and call.args and not isinstance(call.args[0], ast.JoinedStr):
                values = [node.value for node in ast.walk(call.args[0]) if isinstance(node, ast.Constant)]
                found |= {value for value in values if isinstance(value, str) and re.fullmatch("[a-z_]+", value)}
    return found


@pytest.fixture
def made(name, platform, tmp_path):
    """The service, made and not started, and the type of its table."""
    service_name, config_name, _ = SERVICES[name]
    config_type = getattr(importlib.import_module(f"sonarpost.services.{name}.config"), config_name)
    service_type = getattr(importlib.import_module(f"sonarpost.services.{name}.service"), service_name)
    given = {"port": str(tmp_path / "port"), "site": "x"}
    fields = config_type.model_fields
    # The port of a modem is a text; another's has a default.
    wanted = {key: value for key, value in given.items() if key in fields and fields[key].annotation is not int}
    config = config_type(**wanted)
    service = service_type(platform("x"), config)
    yield service, config_type
    service.stop()


@pytest.fixture
def page(name):
    return Page(name)


every_service = pytest.mark.parametrize("name", list(SERVICES))


@every_service
def test_every_configuration_key_is_there_and_no_other(name, page, made):
    config_type = made[1]
    rows = {quoted(row[0])[0]: row for row in page.rows("Configuration") if row[0].startswith("`")}
    assert set(rows) == set(config_type.model_fields)
    for key, row in rows.items():
        default = config_type.model_fields[key].get_default(call_default_factory=True)
        assert len(row) == 5, row
        if default is PydanticUndefined:
            assert "must be given" in row[3]
        elif default is not None:
            text = quoted(row[3])[0] if quoted(row[3]) else row[3]
            told = tomllib.loads(f"value = {text}")["value"]
            assert told == TypeAdapter(type(default)).dump_python(default, mode="json")
        assert row[4], f"{key} has no meaning"
        unit = {"_s": "s", "_px": "px", "_bytes": "bytes"}
        for suffix, wanted in unit.items():
            if key.endswith(suffix) and default is not None:
                assert row[2] == wanted, f"unit of {key}"
    assert f"[{name}]" in page.text


@every_service
def test_every_consumed_key_is_there_with_its_record(name, page, made):
    told = {filled(quoted(row[1])[0]): quoted(row[2])[0] for row in page.key_rows() if row[0] == "in"}
    assert told == {key: record.TYPE for key, record in made[0].consumed_keys().items()}


@every_service
def test_every_produced_key_is_there_and_no_other(name, page, made):
    told = [filled(quoted(row[1])[0]) for row in page.key_rows() if row[0] == "out"]
    assert len(told) == len(set(told))
    produced = keys_in_code(name) - set(made[0].consumed_keys()) - ONLY_COMPARED.get(name, set())
    assert set(told) == produced | {keys.health("x", name), keys.alive("x", name)}


@every_service
def test_records_and_consumers_exist(name, page):
    types = {t.TYPE for t in vars(messages).values() if isinstance(t, type) and issubclass(t, Record)} - {""}
    for row in page.key_rows():
        assert "liveliness" in row[2] or quoted(row[2])[0] in types
        for consumer in quoted(row[3]):
            assert consumer in SERVICES
            assert row[3].startswith("durable")


@every_service
def test_every_placeholder_is_the_platform_the_service_runs_on(name, page):
    for row in page.key_rows():
        if "/health/" in row[1] or "/alive/" in row[1]:
            assert f"v1/{{{SERVICES[name][2]}}}/" in row[1]


@every_service
def test_every_counter_and_gauge_is_there_and_no_other(name, page, made):
    service = made[0]
    sources = trees(name)
    if isinstance(service.config, ModemServiceConfig):
        sources.append(ast.parse((RUNTIME / "modem_service.py").read_text(encoding="utf-8")))
    own = counters_in_code(sources) | COMPOSED_COUNTERS.get(name, set())
    if service.consumed_keys():
        own |= counters_in_code([ast.parse((RUNTIME / "service.py").read_text(encoding="utf-8"))])
    gauges = set(service.gauges()) | BASE_GAUGES
    told = [word for row in page.rows("Health") for word in quoted(row[0])]
    assert len(told) == len(set(told))
    assert set(told) == own | gauges


@every_service
def test_the_page_has_every_part(name, page):
    assert page.text.startswith(f"# {name}: ")
    for heading in ("Zenoh keys", "Configuration", "When something fails", "(Storage|What it stores)", "Health"):
        assert re.search(rf"^## {heading}$", page.text, flags=re.MULTILINE), heading
    assert f"`{name}.db`" in page.text
    assert len(page.rows("When something fails")) >= 5


def test_the_check_would_notice():
    """A page that lacks a key, or has one too many, does not pass."""
    page = Page("c2")
    whole = [filled(quoted(row[1])[0]) for row in page.key_rows()]
    page.text = page.text.replace("| out | `sonarpost/v1/{site}/contact/{vessel}/image`", "| | `gone`")
    assert len(page.key_rows()) == len(whole) - 1
    assert keys_in_code("c2") >= {keys.shore_image("x", "x"), keys.shore_decision("x", "x")}
    assert "images_stored" in counters_in_code(trees("c2"))
