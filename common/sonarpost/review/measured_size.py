"""Size of an object as operators measured it, for lists, reports and exports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Final

from sonarpost.review.measurement import summary


@dataclass(frozen=True, slots=True)
class MeasuredSize:
    """Latest measurement of each quantity, with its standard deviation; None if operators did not measure it.

    Attributes:
        length_m: Length of the object.
        length_sigma_m: Its standard deviation.
        width_m: Width of the object.
        width_sigma_m: Its standard deviation.
        shadow_m: Length of the shadow.
        shadow_sigma_m: Its standard deviation.
        height_m: Height above the seabed, from the shadow.
        height_sigma_m: Its standard deviation.
    """

    length_m: float | None = None
    length_sigma_m: float | None = None
    width_m: float | None = None
    width_sigma_m: float | None = None
    shadow_m: float | None = None
    shadow_sigma_m: float | None = None
    height_m: float | None = None
    height_sigma_m: float | None = None

    @property
    def text(self) -> str:
        """Measured quantities for people: L 1.84 ± 0.09 m, W 0.52 ± 0.06 m; empty without measurements."""
        return ", ".join(f"{letter} {value}" for letter, value in self.rows().items())

    def rows(self) -> dict[str, str]:
        """Return the measured quantities as text by their letter: L, W, shadow, H."""
        found = {}
        for letter, kind in (("L", "length"), ("W", "width"), ("shadow", "shadow"), ("H", "height")):
            value_m, sigma_m = getattr(self, f"{kind}_m"), getattr(self, f"{kind}_sigma_m")
            if value_m is not None:
                found[letter] = f"{value_m:.2f} m" if sigma_m is None else f"{value_m:.2f} ± {sigma_m:.2f} m"
        return found


SIZE_FIELDS: Final = tuple(field.name for field in fields(MeasuredSize))


def measured_size(measurements: Sequence[Mapping[str, object]]) -> MeasuredSize:
    """Return the size from the stored measurements of a contact, oldest first; see `summary`."""
    values: dict[str, float] = {}
    for kind, found in summary(measurements).items():
        for name, value in (("m", found and found["value_m"]), ("sigma_m", found and found["sigma_m"])):
            if isinstance(value, float):
                values[f"{kind}_{name}"] = value
    return MeasuredSize(**values)
