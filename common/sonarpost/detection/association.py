"""Association of repeated detections: which detections from overlapping pings are one object.

A line is recorded in several files, and a long file is processed in strips. Objects near a boundary are detected
twice. Two programs use this module, with different rules for contacts at the end of a file:

- `sonarpost.detection.stream`, for commands, has whole files in memory. It holds contacts near the end of a file back
  and detects them again together with the next file.
- `atd_stub` has strips of files of any length and keeps its state over restarts. It replaces a held contact by the
  same contact from the next file, or releases it unchanged if that file does not contain it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Self

from sonarpost.detection.detector import Detection
from sonarpost.sonar.survey import Side

DEFAULT_ROW_SPACING_M: Final = 0.2
"""Distance between two rows if the survey does not contain it, as in the settings of the detector."""


@dataclass(frozen=True, slots=True)
class DetectionPosition:
    """The place of a detection in a stream of pings.

    Places are compared by rows, not by time, so that a stopped clock does not merge all contacts.

    Attributes:
        side: Side of the vehicle.
        row: Row of the centre of the highlight.
        first_row: First row of the highlight.
        end_row: One past its last row.
        slant_range_m: Slant range of its centre.
        along_m: Distance between two rows.
    """

    side: Side
    row: int
    first_row: int
    end_row: int
    slant_range_m: float
    along_m: float

    @classmethod
    def of_detection(
        cls, detection: Detection, first_row: int = 0, default_along_m: float = DEFAULT_ROW_SPACING_M
    ) -> Self:
        """Return the place of a detection.

        Args:
            detection: The detection.
            first_row: Row in the stream of the first ping of the detection's survey.
            default_along_m: Distance between two rows if the detection has none.
        """
        along_m = detection.pixel_along_m if detection.pixel_along_m is not None else default_along_m
        first, end = detection.highlight_pings
        place = cls(detection.side, detection.ping_index, first, end, detection.slant_range_m, along_m)
        return place.shifted(first_row)

    def shifted(self, rows: int) -> Self:
        """Return the place with `rows` added to its rows."""
        return replace(self, row=self.row + rows, first_row=self.first_row + rows, end_row=self.end_row + rows)

    def is_near(self, other: DetectionPosition, along_m: float, across_m: float, *, overlapping: bool = False) -> bool:
        """Return whether two detections are one object: on the same side, and near in both directions.

        Args:
            other: Another detection, with rows of the same stream.
            along_m: Centres nearer than this are near along-track, at the distance between rows of this detection.
            across_m: Centres nearer than this in slant range are near across-track.
            overlapping: Whether highlights with a common row are also near along-track: a detection at a boundary
                covers only a part of the object.
        """
        if self.side is not other.side or not abs(self.slant_range_m - other.slant_range_m) < across_m:
            return False
        overlap = overlapping and self.first_row < other.end_row and other.first_row < self.end_row
        return overlap or abs(self.row - other.row) * self.along_m < along_m
