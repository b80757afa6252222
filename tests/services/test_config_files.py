"""The project's configuration files load for every service; a mistake in them is named with its line."""

import importlib
import inspect
import json
import re
import tomllib

import pytest
import zenoh
from builders.common import REPOSITORY

from sonarpost.config import SERVICES, ServiceConfig, load
from sonarpost.errors import ConfigError
from sonarpost.runtime.modem_service import ModemServiceConfig

PLATFORMS = {
    "uuv": ("atd_stub", "compressor", "uuv_modem"),
    "vessel": ("op_modem", "decompressor", "relay", "console"),
    "shore": ("c2", "console"),
}
PAIRS = [(file, service) for file, services in PLATFORMS.items() for service in services]


def table_of(service):
    module = importlib.import_module(f"sonarpost.services.{service}.config")
    found = [
        t
        for _, t in inspect.getmembers(module, inspect.isclass)
        if issubclass(t, ServiceConfig) and t.__module__ == module.__name__ and t.__name__.endswith("Config")
    ]
    [table] = found
    return table


def path_of(file):
    return REPOSITORY / "config" / f"{file}.toml"


@pytest.mark.parametrize(("file", "service"), PAIRS)
def test_the_file_loads_for_every_service_of_its_platform(file, service):
    platform, table = load(path_of(file), service, table_of(service), {})
    assert platform.id.startswith(file)
    written = tomllib.loads(path_of(file).read_text(encoding="utf-8"))[service]
    for key, value in written.items():
        assert table.model_dump(mode="json")[key] == value


@pytest.mark.parametrize("file", list(PLATFORMS))
def test_the_file_has_a_table_for_each_of_its_services_and_no_other(file):
    tables = tomllib.loads(path_of(file).read_text(encoding="utf-8"))
    assert set(tables) == {"platform", *PLATFORMS[file]}
    assert set(tables) <= {"platform", *SERVICES}


def test_every_service_but_the_emulator_belongs_to_a_platform():
    assert {service for _, service in PAIRS} == set(SERVICES) - {"acoustic_channel"}


@pytest.mark.parametrize(
    ("file", "service", "key"),
    [
        (file, table, key)
        for file, services in PLATFORMS.items()
        for table in ("platform", *services)
        for key in tomllib.loads(path_of(file).read_text(encoding="utf-8"))[table]
    ],
)
def test_a_misspelt_key_is_refused_with_file_and_line(file, service, key, tmp_path):
    lines = path_of(file).read_text(encoding="utf-8").splitlines()
    header = lines.index(f"[{service}]")
    number = next(n for n in range(header + 1, len(lines)) if re.match(rf"{key}\s*=", lines[n]))
    lines[number] = lines[number].replace(key, f"{key}x", 1)
    path = tmp_path / f"{file}.toml"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    reader = PLATFORMS[file][0] if service == "platform" else service
    with pytest.raises(ConfigError) as caught:
        load(path, reader, table_of(reader), {})
    # A required key that is misspelt is missing as well: then the table is named, and that is as good.
    if f"{key}x" in str(caught.value):
        assert caught.value.where == f"{path}:{number + 1}"
        assert caught.value.field == f"{service}.{key}x"
        assert f" {key}" in caught.value.expected
    else:
        assert caught.value.field == f"{service}.{key}"
        assert caught.value.where.startswith(f"{path}:")


@pytest.mark.parametrize("file", list(PLATFORMS))
def test_a_misspelt_table_is_refused_with_its_line(file, tmp_path):
    service = PLATFORMS[file][0]
    text = path_of(file).read_text(encoding="utf-8").replace(f"[{service}]", f"[{service}s]")
    path = tmp_path / f"{file}.toml"
    path.write_text(text, encoding="utf-8")
    number = text.splitlines().index(f"[{service}s]") + 1
    with pytest.raises(ConfigError, match="unknown table") as caught:
        load(path, service, table_of(service), {})
    assert caught.value.where == f"{path}:{number}"


def test_both_ends_of_the_link_fit_together():
    _, uuv = load(path_of("uuv"), "uuv_modem", table_of("uuv_modem"), {})
    _, vessel = load(path_of("vessel"), "op_modem", table_of("op_modem"), {})
    _, compressor = load(path_of("uuv"), "compressor", table_of("compressor"), {})
    _, decompressor = load(path_of("vessel"), "decompressor", table_of("decompressor"), {})
    assert isinstance(uuv, ModemServiceConfig)
    assert isinstance(vessel, ModemServiceConfig)
    assert uuv.destination == vessel.address != uuv.address
    assert compressor.codebook in decompressor.codebooks
    assert vessel.vehicles[str(uuv.address)] == load(path_of("uuv"), "atd_stub", table_of("atd_stub"), {})[0].id


@pytest.mark.parametrize("path", sorted((REPOSITORY / "config").glob("router-*.json5")), ids=lambda path: path.stem)
def test_a_router_without_authentication_listens_on_the_loopback_address_only(path):
    endpoints = json.loads(zenoh.Config.from_file(str(path)).get_json("listen/endpoints"))
    assert endpoints
    for endpoint in endpoints:
        assert re.fullmatch(r"tcp/127\.0\.0\.1:\d+", endpoint)
