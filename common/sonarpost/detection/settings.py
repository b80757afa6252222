"""Settings of the detector. The defaults work without tuning."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from sonarpost.errors import ConfigError
from sonarpost.sonar.options import load_table
from sonarpost.wire import first_error


def _as_tuple(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


# Settings are validated in strict mode, in which a list is no tuple.
_FromList = BeforeValidator(_as_tuple)
_Length = Annotated[float, Field(gt=0, le=10_000)]
_Size = Annotated[tuple[_Length, _Length], _FromList]
# The matched filter needs memory in proportion to its greatest object.
_ObjectLength = Annotated[float, Field(gt=0, le=50)]
_ObjectLengths = Annotated[tuple[_ObjectLength, ...], Field(min_length=1, max_length=16), _FromList]
_ObjectSize = Annotated[tuple[_ObjectLength, _ObjectLength], _FromList]
_ObjectSizes = Annotated[tuple[_ObjectSize, ...], Field(min_length=1, max_length=16), _FromList]


class DetectorTuning(BaseModel):
    """Object sizes, windows and limits of the detector. Lengths are in metres; across-track they are slant range.

    Attributes:
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
        separation_along_m: Candidates nearer than this along-track, and `separation_across_m` across, are one contact.
        separation_across_m: See `separation_along_m`.
        classifier: File with the weights of the classifier of candidates; None for the one of the package.
        classifier_identity: Identity that this file must have, 16 hexadecimal digits; None for any.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    cell_across_m: _Length = 0.06
    assumed_row_along_m: _Length = 0.2
    median_window_pings: Annotated[int, Field(gt=0, le=100_000)] = 400
    bottom_step_m: _Length = 1.0
    blanking_m: _Length = 0.7
    bottom_margin_m: _Length = 0.3
    highlight_sizes_m: _ObjectSizes = ((0.4, 0.25), (0.9, 0.4), (1.8, 0.6), (4.0, 0.9))
    shadow_lengths_m: _ObjectLengths = (0.6, 1.4, 3.0, 6.0)
    noise_window_m: _Size = (24.0, 12.0)
    guard_m: _Length = 0.6
    ring_m: _Length = 1.5
    min_matched_response: Annotated[float, Field(gt=0, le=1000)] = 1.2
    separation_along_m: _Length = 3.0
    separation_across_m: _Length = 3.0
    classifier: Annotated[str, Field(min_length=1, max_length=4096)] | None = None
    classifier_identity: Annotated[str, Field(pattern="^[0-9a-f]{16}$")] | None = None


class DetectorSettings(DetectorTuning):
    """All settings of a detector: its tuning, the threshold, and the division of long recordings.

    Attributes:
        confidence_threshold: Minimum confidence (0 to 2) of a contact: twice its probability of a mine-like object.
        max_contacts: Maximum number of contacts of a survey, most confident first; None for no limit.
        join_overlap_pings: Pings that consecutive parts of a recording, and consecutive files, have in common.
    """

    confidence_threshold: Annotated[float, Field(ge=0, le=2)] = 0.3
    max_contacts: Annotated[int, Field(gt=0)] | None = None
    join_overlap_pings: Annotated[int, Field(ge=0, le=900)] = 200


def load_settings(path: Path) -> DetectorSettings:
    """Read settings from a TOML file with the fields of `DetectorSettings`.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or contains an invalid field or value.
    """
    return checked_settings(load_table(path), str(path))


def checked_settings(table: Mapping[str, object], where: str) -> DetectorSettings:
    """Return settings from their names and values.

    Raises:
        ConfigError: A name or value is invalid; names `where`.
    """
    try:
        return DetectorSettings.model_validate(table, strict=True)
    except ValidationError as error:
        raise ConfigError(where, *first_error(error)) from error
