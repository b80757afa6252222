"""What a survey file does not say, and its owner must: projection, mounting of the sonar, how good the sensors are."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sonarpost.errors import ConfigError

_MAX_BYTES = 1 << 16
_Offset = Annotated[float, Field(ge=-1000, le=1000, allow_inf_nan=False)]
_Sigma = Annotated[float, Field(ge=0, le=10_000, allow_inf_nan=False)]


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Mounting(_Section):
    """Where the sonar is, seen from the antenna or vehicle whose position the file holds.

    Attributes:
        forward_m: Sonar ahead of that point (negative: behind it).
        starboard_m: Sonar to starboard of it.
        layback_m: Horizontal distance of a towed body behind it, taken along the heading.
        heading_offset_deg: Added to the recorded heading (a compass or transducer mounted askew).
    """

    forward_m: _Offset = 0.0
    starboard_m: _Offset = 0.0
    layback_m: Annotated[float, Field(ge=0, le=10_000)] = 0.0
    heading_offset_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0

    @property
    def ahead_m(self) -> float:
        """How far the sonar lies ahead of the recorded position, in metres."""
        return self.forward_m - self.layback_m

    @property
    def moves(self) -> bool:
        """Whether the sonar is somewhere else than the recorded position."""
        return bool(self.ahead_m or self.starboard_m)


class ErrorBudget(_Section):
    """One standard deviation of each thing that goes into the position of a sample.

    The defaults are those of a small vehicle that dives on dead reckoning between fixes; a survey with better or
    worse sensors states its own.

    Attributes:
        position_m: Of the recorded position, along each axis.
        heading_deg: Of the heading, mounting included.
        altitude_m: Of an altitude from the file.
        tracked_altitude_m: Of an altitude from the picture (`track_bottom`).
        sound_speed: Of the speed of sound the recorder assumed, as a fraction.
        bottom_slope_deg: Of the bottom's slope across the track: the flat bottom is an assumption.
        time_s: Of the ping's time against the position's.
        layback_m: Of the layback, where there is one.
    """

    position_m: _Sigma = 5.0
    heading_deg: _Sigma = 2.0
    altitude_m: _Sigma = 0.2
    tracked_altitude_m: _Sigma = 0.5
    sound_speed: Annotated[float, Field(ge=0, le=0.5)] = 0.01
    bottom_slope_deg: Annotated[float, Field(ge=0, le=45)] = 2.0
    time_s: _Sigma = 0.2
    layback_m: _Sigma = 5.0


class SurveyOptions(_Section):
    """How survey files are to be understood where they leave a choice.

    Attributes:
        projected_crs: Coordinate system of positions in metres, as pyproj takes it (`EPSG:32619`). Without it a
            file in metres has no positions.
        position_source: Which of XTF's two positions is taken: the sensor's, or the ship's (for a recorder that
            left the sensor's at the ship's or at zero; give a layback with it).
        port_order: Order of XTF's port samples; the format says farthest first, some recorders differ.
        humminbird_sample_spacing_m: Slant range of one sample; Humminbird recordings do not hold it.
        humminbird_depth_as_altitude: The echo sounder's depth is the altitude; else the picture tells it.
        mounting: Where the sonar is.
        errors: How good positions, headings and altitudes are.
    """

    projected_crs: str | None = None
    position_source: Literal["sensor", "ship"] = "sensor"
    port_order: Literal["farthest_first", "nearest_first"] = "farthest_first"
    humminbird_sample_spacing_m: Annotated[float, Field(gt=0, le=1)] | None = None
    humminbird_depth_as_altitude: bool = False
    mounting: Mounting = Mounting()
    errors: ErrorBudget = ErrorBudget()


def load_options(path: Path) -> SurveyOptions:
    """Read options from a TOML file with the fields of `SurveyOptions`, `[mounting]` and `[errors]` as tables.

    Raises:
        ConfigError: The file cannot be read, is not TOML, or a value is not one of the field's.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ConfigError(str(path), "file size", path.stat().st_size, f"at most {_MAX_BYTES} bytes")
        table = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise ConfigError(str(path), "", error.strerror or str(error), "a readable TOML file") from error
    except ValueError as error:  # not UTF-8, or not TOML
        raise ConfigError(str(path), "", str(error), "TOML") from error
    try:
        return SurveyOptions.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"])
        raise ConfigError(str(path), field, first["input"], first["msg"]) from error
