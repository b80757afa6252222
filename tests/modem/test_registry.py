"""Registry of modem drivers, and what the interface checks for all of them."""

from dataclasses import replace
from importlib.metadata import EntryPoint

import pytest

from sonarpost.config import ModemTable
from sonarpost.errors import ConfigError, FrameError
from sonarpost.modem import registry
from sonarpost.modem.interface import ModemCapabilities, RateInfo
from sonarpost.modem.micromodem import CAPABILITIES
from sonarpost.modem.registry import ModemSettings, default_registry, drivers, modem_driver

GROUP = registry.ENTRY_POINT_GROUP


def plugin(name: str, value: str) -> EntryPoint:
    return EntryPoint(name, value if ":" in value else f"builders.other_modem:{value}", GROUP)


def test_every_builtin_loads_under_its_name() -> None:
    for name in default_registry().names():
        assert modem_driver(name).name == name
        assert modem_driver(name).summary


def test_default_of_the_configuration_is_that_of_the_registry() -> None:
    assert ModemTable().driver == registry.DEFAULT_DRIVER == modem_driver().name


def test_driver_of_another_distribution_is_found() -> None:
    found = drivers([plugin("other", "OTHER")])
    assert "other" in found.names()
    assert found.get("other").create(ModemSettings(3), "port").capabilities is CAPABILITIES


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("broken", "BROKEN", "a sonarpost.modem.registry.ModemDriver"),
        ("another", "OTHER", "the name of the entry point"),
        ("missing", "sonarpost_no_such_module:X", "an object that imports"),
    ],
)
def test_invalid_entry_point_is_named(name: str, value: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        drivers([plugin(name, value)]).get(name)
    assert f"{GROUP}:{name}" in str(caught.value)


def test_unknown_name_is_refused_and_a_plug_in_replaces_no_driver() -> None:
    with pytest.raises(ConfigError, match=r"one of .*micromodem"):
        modem_driver("no-such-modem")
    assert drivers([plugin("micromodem", "OTHER")]).get("micromodem") is modem_driver("micromodem")


RATE = RateInfo(1, "test", 2, 64, 1.0)


@pytest.mark.parametrize(
    "wrong",
    [
        replace(CAPABILITIES, max_address=256),
        replace(CAPABILITIES, min_address=9, max_address=8),
        replace(CAPABILITIES, uplink_rate=77),
        replace(CAPABILITIES, downlink_rate=77),
        ModemCapabilities({1: replace(RATE, number=2)}, 1, 1),
        ModemCapabilities({1: replace(RATE, frames=256)}, 1, 1),
        ModemCapabilities({1: replace(RATE, frame_bytes=0)}, 1, 1),
        ModemCapabilities({1: replace(RATE, airtime_s=0.0)}, 1, 1),
        ModemCapabilities({300: replace(RATE, number=300)}, 300, 300),
    ],
)
def test_capabilities_that_records_cannot_carry_are_refused(wrong: ModemCapabilities) -> None:
    with pytest.raises(ConfigError):
        registry.check_capabilities(wrong, "driver test")


@pytest.mark.parametrize(
    ("destination", "rate", "frames", "field"),
    [
        (-1, 1, [b"x"], "destination"),
        (21, 1, [b"x"], "destination"),
        (2, 3, [b"x"], "rate"),
        (2, 1, [], "frames"),
        (2, 1, [b"x"] * 3, "frames"),
        (2, 1, [b"x", bytes(65)], "length of frame 2"),
    ],
)
def test_packet_that_the_modem_cannot_send_is_refused(
    destination: int, rate: int, frames: list[bytes], field: str
) -> None:
    modem = ModemCapabilities({1: RATE}, 1, 1, max_address=20, broadcast=99)
    modem.check_packet(99, 1, [b"", bytes(64)])
    with pytest.raises(FrameError) as caught:
        modem.check_packet(destination, rate, frames)
    assert caught.value.field == field
