"""The project's configuration files load for every service."""

import tomllib

import pytest
from builders.common import REPOSITORY

from sonarpost.cli.deployment.config_files import configuration_type
from sonarpost.config import SERVICES, load

PLATFORMS = {
    "uuv": ("atd_stub", "compressor", "uuv_modem"),
    "vessel": ("op_modem", "decompressor", "relay", "console"),
    "shore": ("c2", "console"),
}
PAIRS = [(file, service) for file, services in PLATFORMS.items() for service in services]


def path_of(file):
    return REPOSITORY / "config" / f"{file}.toml"


@pytest.mark.parametrize(("file", "service"), PAIRS)
def test_the_file_loads_for_every_service_of_its_platform(file, service):
    platform, table = load(path_of(file), service, configuration_type(service), {})
    assert platform.id.startswith(file)
    written = tomllib.loads(path_of(file).read_text(encoding="utf-8"))[service]
    for key, value in written.items():
        assert table.model_dump(mode="json")[key] == value


def test_each_file_has_a_table_for_each_of_its_services_and_no_other():
    for file, services in PLATFORMS.items():
        tables = tomllib.loads(path_of(file).read_text(encoding="utf-8"))
        assert set(tables) == {"platform", *services}
    assert {service for _, service in PAIRS} == set(SERVICES)


def test_both_ends_of_the_link_fit_together():
    _, uuv = load(path_of("uuv"), "uuv_modem", configuration_type("uuv_modem"), {})
    _, vessel = load(path_of("vessel"), "op_modem", configuration_type("op_modem"), {})
    _, compressor = load(path_of("uuv"), "compressor", configuration_type("compressor"), {})
    _, decompressor = load(path_of("vessel"), "decompressor", configuration_type("decompressor"), {})
    assert uuv.destination == vessel.address != uuv.address
    assert compressor.codebook in decompressor.codebooks
    assert (
        vessel.vehicles[str(uuv.address)] == load(path_of("uuv"), "atd_stub", configuration_type("atd_stub"), {})[0].id
    )
