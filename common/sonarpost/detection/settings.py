"""Settings of the detector. The defaults work without tuning."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """Object sizes, windows and thresholds of the detector. Lengths are in metres; across-track they are slant range.

    Attributes:
        confidence_threshold: Minimum fused confidence (0 to 2) of a contact; 1.0 is the operating point.
        max_contacts: Maximum number of contacts of a survey, most confident first; None for no limit.
        cell_across_m: Target slant range of one grid cell; the samples of the file are averaged to it.
        assumed_row_along_m: Distance between pings if the file has neither speed nor track.
        median_window_pings: Window of the median echo at each range.
        bottom_step_m: Range before and after the first bottom return over which the rise is measured.
        blanking_m: Range next to the transducer in which no bottom return is searched (transmit pulse).
        bottom_margin_m: Range after the first bottom return that is not searched (nadir glare).
        highlight_sizes_m: Highlight sizes of the matched filter, each (along-track, across-track).
        shadow_lengths_m: Shadow lengths of the matched filter.
        noise_window_m: Along-track and across-track extent of the neighbourhood that defines the local noise.
        guard_m: Guard distance between a highlight and the ring of seabed of the CFAR test.
        ring_m: Width of that ring.
        min_matched_response: Minimum matched-filter response, in local noise units, of a candidate.
        clutter_radius_m: Distance, along and across, within which other candidates define the local clutter.
        clutter_area_m2: Area of seabed for each accepted candidate: the local clutter level is the evidence that one
            candidate in this area reaches.
        separation_along_m: Candidates nearer than this along-track, and `separation_across_m` across, are one contact.
        separation_across_m: See `separation_along_m`.
        mine_length_m: Minimum and maximum highlight length of a mine-like contact.
        mine_width_m: Minimum and maximum highlight width of a mine-like contact.
        mine_height_m: Minimum and maximum height of a mine-like contact, if the altitude is known.
        mine_elongation: Maximum ratio of the longer to the shorter side of the highlight of a mine-like contact.
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
    min_matched_response: float = 1.6
    clutter_radius_m: float = 30.0
    clutter_area_m2: float = 90.0
    separation_along_m: float = 3.0
    separation_across_m: float = 3.0
    mine_length_m: tuple[float, float] = (0.3, 4.0)
    mine_width_m: tuple[float, float] = (0.1, 2.5)
    mine_height_m: tuple[float, float] = (0.1, 2.0)
    mine_elongation: float = 8.0

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ValueError: A length, size or response is not a finite number above 0, the confidence threshold is not
                within 0 to 2, or there is no highlight size or shadow length.
        """
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name != "confidence_threshold" and not all(math.isfinite(n) and n > 0 for n in _numbers(value)):
                raise ValueError(f"{item.name}: got {value!r}, expected finite numbers above 0")
        if not 0 <= self.confidence_threshold <= 2:
            raise ValueError(f"confidence_threshold: got {self.confidence_threshold!r}, expected 0 to 2")
        if not self.highlight_sizes_m or not self.shadow_lengths_m:
            raise ValueError("highlight_sizes_m, shadow_lengths_m: got an empty tuple, expected at least one size")


def _numbers(value: object) -> list[float]:
    """Return every number in nested tuples; none for None."""
    if isinstance(value, tuple):
        return [n for item in value for n in _numbers(item)]
    return [float(value)] if isinstance(value, (int, float)) else []
