"""Association of repeated detections: which detections from overlapping parts of a recording are one object."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from sonarpost.detection.detector import Detection
from sonarpost.detection.settings import DetectorSettings
from sonarpost.sonar.survey import Side


@dataclass(frozen=True, slots=True)
class DetectionPlace:
    """The place of a detection in a stream of pings.

    Places are compared by rows, not by time, so that a stopped clock does not merge all contacts.

    Attributes:
        side: Side of the vehicle.
        row: Row of the centre of the highlight.
        first_row: First row of the highlight.
        end_row: One past its last row.
        slant_range_m: Slant range of its centre.
        near_m: Slant range of its near edge.
        far_m: Slant range of the end of its shadow.
        along_m: Distance between two rows.
    """

    side: Side
    row: int
    first_row: int
    end_row: int
    slant_range_m: float
    near_m: float
    far_m: float
    along_m: float

    @classmethod
    def of_detection(cls, detection: Detection, settings: DetectorSettings, first_row: int = 0) -> Self:
        """Return the place of a detection.

        Args:
            detection: The detection.
            settings: For the distance between two rows if the detection has none.
            first_row: Row in the stream of the first ping of the detection's survey.
        """
        d = detection
        place = cls(
            side=d.side,
            row=d.ping_index,
            first_row=d.highlight_pings[0],
            end_row=d.highlight_pings[1],
            slant_range_m=d.slant_range_m,
            near_m=d.highlight_samples[0] * d.pixel_across_m,
            far_m=(d.highlight_samples[1] + d.shadow_samples) * d.pixel_across_m,
            along_m=d.pixel_along_m if d.pixel_along_m is not None else settings.assumed_row_along_m,
        )
        return place.shifted(first_row)

    def shifted(self, rows: int) -> Self:
        """Return the place with `rows` added to its rows."""
        return replace(self, row=self.row + rows, first_row=self.first_row + rows, end_row=self.end_row + rows)

    def is_same_object(self, other: DetectionPlace, settings: DetectorSettings) -> bool:
        """Return whether two detections are one object, as within one search.

        They are on one side. Their centres lie within `separation_along_m` and `separation_across_m`; or their
        highlights have a common row, because one of them covers only a part of the object, and their centres lie within
        `separation_across_m`, or the highlight of one lies in highlight or shadow of the other.
        """
        if self.side is not other.side:
            return False
        is_near = abs(self.slant_range_m - other.slant_range_m) < settings.separation_across_m
        if self.first_row < other.end_row and other.first_row < self.end_row:
            return is_near or (self.near_m < other.far_m and other.near_m < self.far_m)
        return is_near and abs(self.row - other.row) * self.along_m < settings.separation_along_m
