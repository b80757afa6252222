"""Survey options: what survey files do not contain (projection, mounting of the sonar, accuracy of the sensors)."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError

from sonarpost.errors import ConfigError
from sonarpost.wire import first_error

_MAX_BYTES = 1 << 16
_Offset = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]
_Sigma = Annotated[float, Field(ge=0, le=10_000, allow_inf_nan=False)]


def _check_projected_crs(crs: str) -> str:
    # Imported here: pyproj takes 0.1 s, and most commands and services use no projection.
    from sonarpost.sonar.projection import Projection  # noqa: PLC0415

    Projection(crs)
    return crs


ProjectedCrs = Annotated[str, AfterValidator(_check_projected_crs)]
"""Projected coordinate system, as pyproj accepts it."""


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Mounting(_Section):
    """Position of the sonar relative to the recorded position (antenna or vehicle).

    Attributes:
        forward_m: Sonar ahead of the recorded position (negative: behind it).
        starboard_m: Sonar to starboard of it.
        layback_m: Horizontal distance of a towed body behind it, along the heading.
        heading_offset_deg: Added to the recorded heading (compass or transducer mounted at an angle).
    """

    forward_m: _Offset = 0.0
    starboard_m: _Offset = 0.0
    layback_m: Annotated[float, Field(ge=0, le=10_000)] = 0.0
    heading_offset_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0

    @property
    def ahead_m(self) -> float:
        """Distance of the sonar ahead of the recorded position, in metres."""
        return self.forward_m - self.layback_m

    @property
    def is_offset(self) -> bool:
        """Whether the position of the sonar differs from the recorded one."""
        return bool(self.ahead_m or self.starboard_m)


class ErrorBudget(_Section):
    """Standard deviations of the quantities that determine the position of a sample.

    The defaults are those of a small vehicle that dives on dead reckoning between fixes.

    Attributes:
        position_m: Recorded position, along each axis.
        heading_deg: Heading of the sensor, mounting included.
        gyro_heading_deg: Heading of the ship or vehicle in place of the sensor's.
        course_heading_deg: Course over ground in place of a heading: a current makes them differ.
        altitude_m: Altitude from the file.
        tracked_altitude_m: Altitude from bottom tracking (`track_bottom`).
        sound_speed: Sound speed assumed by the recorder, as a fraction.
        bottom_slope_deg: Slope of the bottom across the track, which is assumed flat.
        time_s: Time of the ping relative to the time of the position.
        layback_m: Layback of a towed body.
    """

    position_m: _Sigma = 5.0
    heading_deg: _Sigma = 2.0
    gyro_heading_deg: _Sigma = 3.0
    course_heading_deg: _Sigma = 10.0
    altitude_m: _Sigma = 0.2
    tracked_altitude_m: _Sigma = 0.5
    sound_speed: Annotated[float, Field(ge=0, le=0.5)] = 0.01
    bottom_slope_deg: Annotated[float, Field(ge=0, le=45)] = 2.0
    time_s: _Sigma = 0.2
    layback_m: _Sigma = 5.0


class SurveyOptions(_Section):
    """Interpretation of survey files where the format leaves a choice.

    Attributes:
        projected_crs: Coordinate system of projected positions, in metres or feet, as pyproj accepts it
            (`EPSG:32619`). Without it a file with projected positions has no positions in degrees.
        frequency_hz: Frequency whose channels images and contacts are of, the nearest one of the file; None for the
            highest.
        heading_source: `sensor`, the heading of the sonar itself; `gyro`, of the ship or vehicle; `course`, the course
            over ground, as recorded or from the positions. `auto`: the first of them that the file has.
        position_source: Position field of XTF: the sensor's, or the ship's. `auto`: the ship's if the sensor's is zero
            in all pings.
        recorded_layback: Layback of XTF or JSF, or cable length of XTF: `apply` it along the track, or `ignore` it.
            `auto`: apply it to positions of the ship; elsewhere a note of XTF names it.
        port_order: Order of the port samples of XTF; the format specifies farthest first, some recorders differ.
        humminbird_sample_spacing_m: Slant range of one sample, which Humminbird recordings do not contain.
        humminbird_depth_as_altitude: Use the depth of the echo sounder as altitude, in place of bottom tracking.
        mounting: Position of the sonar.
        errors: Accuracy of positions, headings and altitudes.
    """

    projected_crs: ProjectedCrs | None = None
    frequency_hz: Annotated[float, Field(ge=1e3, le=1e7)] | None = None
    heading_source: Literal["auto", "sensor", "gyro", "course"] = "auto"
    position_source: Literal["auto", "sensor", "ship"] = "auto"
    recorded_layback: Literal["auto", "apply", "ignore"] = "auto"
    port_order: Literal["farthest_first", "nearest_first"] = "farthest_first"
    humminbird_sample_spacing_m: Annotated[float, Field(gt=0, le=1)] | None = None
    humminbird_depth_as_altitude: bool = False
    mounting: Mounting = Mounting()
    errors: ErrorBudget = ErrorBudget()


def load_options(path: Path) -> SurveyOptions:
    """Read options from a TOML file with the fields of `SurveyOptions`, `[mounting]` and `[errors]` as tables.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or contains an invalid field or value.
    """
    return checked_options(load_table(path), str(path))


def load_table(path: Path) -> dict[str, object]:
    """Read a TOML file of options, at most 64 KiB.

    Raises:
        ConfigError: The file cannot be read, is longer, or is not TOML.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError(str(path), "file size", path.stat().st_size, f"at most {_MAX_BYTES} bytes")
        return tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ConfigError(str(path), "", error.strerror or str(error), "a readable TOML file") from error
    except (ValueError, RecursionError) as error:  # not UTF-8, or not TOML
        raise ConfigError(str(path), "", str(error), "TOML") from error


def checked_options(table: Mapping[str, object], where: str) -> SurveyOptions:
    """Return options from their names and values.

    Raises:
        ConfigError: A name or value is invalid; names `where`.
    """
    try:
        return SurveyOptions.model_validate(table)
    except ValidationError as error:
        raise ConfigError(where, *first_error(error)) from error
