"""Which contacts of two looks at one stream of pings are one object.

A line is recorded file after file, and a long file is looked at piece after piece; what lies near a cut is looked at
twice. Two ask here, and differ beyond it on purpose:

- `sonarpost.detection.stream`, for commands, has whole files in memory. It withholds contacts near the end of a file;
  when the next file is there they are forgotten, as that end is looked at once more. The settings say what is near.
- atd_stub has pieces of files of any length, and answers for each contact over restarts. What waits at a file's end is
  replaced by the same contact seen whole, and sent as it is where the second look does not see it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Self

from sonarpost.detection.detector import Detection
from sonarpost.sonar.survey import Side

UNKNOWN_ALONG_M: Final = 0.2
"""Travel between two rows where the survey does not tell it, as in the detector's own settings."""


@dataclass(frozen=True, slots=True)
class DetectionPosition:
    """A contact as it was seen in one look at a stream of pings.

    Rows count in that stream, not in times: a clock that stands still must not make all contacts one.

    Attributes:
        side: The side it was seen on.
        row: Of the highlight's middle.
        first_row: The highlight's first.
        end_row: One past its last.
        slant_range_m: To its middle.
        along_m: Travel between two rows.
    """

    side: Side
    row: int
    first_row: int
    end_row: int
    slant_range_m: float
    along_m: float

    @classmethod
    def of(cls, found: Detection, first_row: int = 0, unknown_along_m: float = UNKNOWN_ALONG_M) -> Self:
        """Return a detection as a look.

        Args:
            found: The detection.
            first_row: Row of the first ping of the survey it was found in.
            unknown_along_m: Travel between two rows where the detection has none.
        """
        along_m = found.pixel_along_m if found.pixel_along_m is not None else unknown_along_m
        first, end = found.highlight_pings
        return cls(found.side, found.ping_index, first, end, found.slant_range_m, along_m).moved(first_row)

    def moved(self, rows: int) -> Self:
        """Return the look in a stream that begins so many rows earlier (later, where `rows` is negative)."""
        return replace(self, row=self.row + rows, first_row=self.first_row + rows, end_row=self.end_row + rows)


@dataclass(frozen=True, slots=True)
class AssociationRule:
    """When two looks were at one object: on one side, and near each other in both directions.

    Attributes:
        along_m: Middles nearer to each other than this are near along-track.
        across_m: And nearer than this are near across-track.
        overlapping: Highlights that share a row are near along-track however far their middles lie apart: a look that
            ends at a cut has seen a part of what the other sees whole.
    """

    along_m: float
    across_m: float
    overlapping: bool

    def holds(self, one: DetectionPosition, other: DetectionPosition, across_m: float) -> bool:
        """Tell whether both are looks at one object.

        Args:
            one: A look, whose travel between rows counts.
            other: Another in the same stream, or with rows that count from the same ping.
            across_m: How far they lie apart across-track: by slant range, or by samples where both have the same.
        """
        if one.side is not other.side or not across_m < self.across_m:
            return False
        overlap = self.overlapping and one.first_row < other.end_row and other.first_row < one.end_row
        return overlap or abs(one.row - other.row) * one.along_m < self.along_m
