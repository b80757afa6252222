"""Settings of the detector, all with defaults that work without tuning."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """What the detector looks for and how strict it is. Lengths are in metres on the slant-range picture.

    Attributes:
        confidence_threshold: Least fused confidence (0 to 2) that becomes a contact; 1.0 is the operating point.
        max_contacts: Greatest number of contacts a survey may give, strongest first; None for no limit.
        cell_across_m: Wanted slant range of one working cell; the file's samples are averaged up to it.
        assumed_row_along_m: Travel between pings for a file that gives neither speed nor track.
        median_window_pings: Pings over which the seabed's median echo is taken for each range.
        bottom_step_m: Range before and after the first bottom return that is compared to find it.
        blanking_m: Range next to the transducer in which no bottom return is looked for (transmit pulse).
        bottom_margin_m: Range after the first bottom return that is not searched (nadir glare).
        highlight_sizes_m: Highlights looked for, each (along-track, across-track).
        shadow_lengths_m: Shadow lengths looked for behind each highlight.
        noise_window_m: Along and across extent of the neighbourhood that defines the local noise.
        guard_m: Distance from a highlight to the ring of seabed the constant-false-alarm test compares it with.
        ring_m: Width of that ring.
        least_matched: Matched-filter response, in local-noise units, below which a place is not looked at closer.
        clutter_radius_m: How far around a place, along and across, other places tell how cluttered the seabed is.
        clutter_area_m2: Seabed to which one contact is granted: the local level of clutter is the evidence that is
            reached by one place in this area.
        separation_along_m: Contacts nearer than this along-track (and across) are one contact.
        separation_across_m: See `separation_along_m`.
        mine_length_m: Least and greatest highlight length of a mine-like contact.
        mine_width_m: Least and greatest highlight width of a mine-like contact.
        mine_height_m: Least and greatest height of a mine-like contact, where the altitude is known.
        mine_elongation: Greatest ratio of the highlight's longer to its shorter side of a mine-like contact.
    """

    confidence_threshold: float = 1.0
    max_contacts: int | None = None
    cell_across_m: float = 0.06
    assumed_row_along_m: float = 0.2
    median_window_pings: int = 400
    bottom_step_m: float = 1.0
    blanking_m: float = 0.7
    bottom_margin_m: float = 0.3
    highlight_sizes_m: tuple[tuple[float, float], ...] = ((0.4, 0.25), (0.9, 0.4), (1.8, 0.6), (4.0, 0.9))
    shadow_lengths_m: tuple[float, ...] = (0.6, 1.4, 3.0, 6.0)
    noise_window_m: tuple[float, float] = (24.0, 12.0)
    guard_m: float = 0.6
    ring_m: float = 1.5
    least_matched: float = 1.6
    clutter_radius_m: float = 30.0
    clutter_area_m2: float = 90.0
    separation_along_m: float = 3.0
    separation_across_m: float = 3.0
    mine_length_m: tuple[float, float] = (0.3, 4.0)
    mine_width_m: tuple[float, float] = (0.1, 2.5)
    mine_height_m: tuple[float, float] = (0.1, 2.0)
    mine_elongation: float = 8.0

    def __post_init__(self) -> None:
        """Refuse what no detector can work with.

        Raises:
            ValueError: A length, size or response is not a finite number above 0, the confidence is not within
                0 to 2, or there is no size to look for.
        """
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name != "confidence_threshold" and not all(math.isfinite(n) and n > 0 for n in _flat(value)):
                raise ValueError(f"{item.name}: got {value!r}, expected finite numbers above 0")
        if not 0 <= self.confidence_threshold <= 2:
            raise ValueError(f"confidence_threshold: got {self.confidence_threshold!r}, expected 0 to 2")
        if not self.highlight_sizes_m or not self.shadow_lengths_m:
            raise ValueError("highlight_sizes_m, shadow_lengths_m: got an empty tuple, expected at least one size")


def _flat(value: object) -> list[float]:
    """Every number in nested tuples; None has none."""
    if isinstance(value, tuple):
        return [n for item in value for n in _flat(item)]
    return [float(value)] if isinstance(value, (int, float)) else []
