"""The water's parameters from a preset, a TOML file and single values, the later over the earlier."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from types import MappingProxyType

from sonarpost.errors import ConfigError
from sonarpost.simulation.channel.channel_config import ChannelParameters
from sonarpost.simulation.channel.random_draws import TailDamage

Value = float | int | bool | str

PRESETS: Mapping[str, Mapping[str, Value]] = MappingProxyType(
    {
        "still": MappingProxyType({}),
        # The paper's trial in Bedford Basin: most packets below 130 m, most lost beyond. See
        # docs/explanation/channel-model.md.
        "sea-trial": MappingProxyType(
            {
                "range_loss": True,
                "snr_at_1m_db": 37.0,
                "snr_spread_db": 1.0,
                "mean_clear_s": 120.0,
                "mean_fade_s": 2.0,
                "fade_loss": 1.0,
            }
        ),
    }
)
"""Sets of parameters by name."""

_KINDS = MappingProxyType({field.name: str(field.type) for field in fields(ChannelParameters)})


def read_parameters(path: Path) -> dict[str, Value]:
    """Read a TOML file of the water's parameters, `preset` among them if it likes.

    Raises:
        ConfigError: The file cannot be read, is no TOML, or has a key or value that the water does not have.
    """
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(str(path), "", str(error), "a TOML file of the water's parameters") from error
    return {name: _checked(str(path), name, value) for name, value in table.items()}


def build_parameters(values: Mapping[str, Value], where: str) -> ChannelParameters:
    """Return the water of a preset, where `values` names one, and the other values over it.

    Raises:
        ConfigError: An unknown preset or parameter, a value of the wrong type or out of its bounds; `where` is named.
    """
    checked = {name: _checked(where, name, value) for name, value in values.items()}
    preset = str(checked.pop("preset", "still"))
    merged: dict[str, object] = {**PRESETS[preset], **checked}
    if "tail_damage_kind" in merged:
        merged["tail_damage_kind"] = TailDamage(merged["tail_damage_kind"])
    try:
        return ChannelParameters(**merged)  # type: ignore[arg-type]
    except ValueError as error:
        name, _, rest = str(error).partition(": ")
        raise ConfigError(where, name, merged.get(name), rest.partition("expected ")[2]) from error


def _checked(where: str, name: str, value: object) -> Value:
    if name == "preset":
        return _one_of(where, name, value, list(PRESETS))
    if name not in _KINDS:
        raise ConfigError(where, name, value, f"one of {', '.join(['preset', *_KINDS])}")
    if name == "tail_damage_kind":
        return _one_of(where, name, value, [kind.value for kind in TailDamage])
    if _KINDS[name] == "bool":
        good = isinstance(value, bool)
    elif _KINDS[name] == "int":
        good = isinstance(value, int) and not isinstance(value, bool)
    else:
        good = isinstance(value, int | float) and not isinstance(value, bool)
    if not good:
        raise ConfigError(
            where, name, value, {"bool": "true or false", "int": "an integer"}.get(_KINDS[name], "a number")
        )
    assert isinstance(value, bool | int | float)
    return value


def _one_of(where: str, name: str, value: object, names: list[str]) -> str:
    if not isinstance(value, str) or value not in names:
        raise ConfigError(where, name, value, f"one of {', '.join(names)}")
    return value
