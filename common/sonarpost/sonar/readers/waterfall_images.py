"""Reader of surveys as waterfall images with a navigation table: `NAME.waterfall.toml` describes the files.

    sonar_id = "my sonar"
    port = "line.port.png"               # row = ping, column = sample; grey TIFF or PNG of 8 or 16 bits
    starboard = "line.stbd.png"
    port_order = "farthest_first"        # or nearest_first; required with port
    navigation = "line.csv"              # a header line, then one line a ping
    positions = "degrees"                # or "metres", with projected_crs here or in the options
    [columns]                            # columns of the table whose name differs from that of the value
    lat_deg = "y_or_lat"

Required columns are `time_utc` (ISO 8601 or seconds since 1970) and `slant_range_m`. Optional columns are `number`,
`lat_deg`, `lon_deg` (or `easting_m`, `northing_m`), `heading_deg`, `altitude_m`, `depth_m`, `speed_mps`, `pitch_deg`,
`roll_deg`; an empty field is unknown. Images are decoded as a whole, within the size limits of `image_files`; the
table is read line by line.
"""

from __future__ import annotations

import csv
import math
import tomllib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from typing_extensions import override

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import Position
from sonarpost.sonar.image_decoding import GreyImage
from sonarpost.sonar.image_files import read_image
from sonarpost.sonar.navigation import (
    KNOT_MPS,
    NAVIGATION_LIMITS,
    PingNotes,
    is_plausible,
    out_of_range,
    position_in_degrees,
)
from sonarpost.sonar.options import ProjectedCrs
from sonarpost.sonar.projection import Projection, grid_coordinates
from sonarpost.sonar.readers.file_source import NO_FIX, FileSource
from sonarpost.sonar.readers.open_file import CheckedFile
from sonarpost.sonar.readers.records import Notes
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Side
from sonarpost.wire import first_error

_MAX_TOML_BYTES: Final = 1 << 16
_COORDINATES: Final = {"degrees": ("lat_deg", "lon_deg"), "metres": ("northing_m", "easting_m")}


def _file_name(name: str) -> str:
    """Return the name of a file in the folder of the description.

    Raises:
        ValueError: It is longer than a name can be, or leads to another folder.
    """
    if name in (".", "..") or not {"/", "\0"}.isdisjoint(name) or len(name.encode()) > 255:
        raise ValueError("the name of a file beside the description, at most 255 bytes")
    return name


_Name = Annotated[str, Field(min_length=1, max_length=255)]
_FileName = Annotated[_Name, AfterValidator(_file_name)]


class WaterfallDescription(BaseModel):
    """Fields of a `.waterfall.toml`, see the module docstring."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    sonar_id: str = "unknown"
    port: _FileName | None = None
    starboard: _FileName | None = None
    port_order: Literal["farthest_first", "nearest_first"] | None = None
    navigation: _FileName
    positions: Literal["degrees", "metres"]
    projected_crs: ProjectedCrs | None = None
    frequency_hz: Annotated[float, Field(gt=0)] | None = None
    knots: bool = False
    zero_is_unknown: bool = False
    columns: dict[str, _Name] = Field(default_factory=dict)


class WaterfallSource(FileSource):
    """An open waterfall survey.

    Raises:
        SurveyFileError: A file is missing or damaged, or the files do not match.
    """

    @override
    def _data_files(self) -> tuple[Path]:
        self._config = _read_description(self.path)
        if self._config.port is not None and self._config.port_order is None:
            raise SurveyFileError(str(self.path), "port_order", None, "farthest_first or nearest_first")
        crs = self._config.projected_crs or self.options.projected_crs
        if self._config.positions == "metres" and crs is None:
            raise SurveyFileError(
                str(self.path), "projected_crs", None, "the coordinate system of positions in metres (--crs)"
            )
        self._projection = Projection(crs) if crs is not None and self._config.positions == "metres" else None
        self._images = self._read_images()
        return (self.path.parent / self._config.navigation,)

    @override
    def _sonar_name(self) -> str:
        return self._config.sonar_id

    @override
    def _validate(self, sonar_id: str, line_name: str) -> None:
        super()._validate(sonar_id, line_name.removesuffix(".waterfall"))

    @staticmethod
    def parts(path: Path) -> tuple[Path, ...]:
        """Return the description, its images and its table; the description alone if it cannot be read."""
        try:
            config = _read_description(path)
        except SurveyFileError:
            return (path,)
        names = (config.port, config.starboard, config.navigation)
        return (path, *(path.parent / name for name in names if name is not None))

    def _read_images(self) -> dict[Side, GreyImage]:
        named = {Side.PORT: self._config.port, Side.STARBOARD: self._config.starboard}
        images = {side: read_image(self.path.parent / name) for side, name in named.items() if name is not None}
        if not images:
            raise SurveyFileError(str(self.path), "port, starboard", None, "the image of at least one side")
        if self._config.port_order == "farthest_first" and Side.PORT in images:
            images[Side.PORT] = images[Side.PORT][:, ::-1]
        return images

    @override
    def _format_warnings(self) -> list[str]:
        return self._notes.pings.lines(self._pings, [NO_FIX, *map(out_of_range, sorted(NAVIGATION_LIMITS))])

    @override
    def _stored_pings(self, notes: Notes) -> Iterator[Ping]:
        count = -1
        for count, values in enumerate(self._lines()):
            if any(count >= image.shape[0] for image in self._images.values()):
                break
            yield self._ping(count, values, notes.pings)
        for side, image in self._images.items():
            if image.shape[0] != count + 1:
                expected = f"a table of {image.shape[0]} lines, as the {side.value} image has rows"
                raise self._file.error("lines", count + 1, expected)

    def _lines(self) -> Iterator[dict[str, str]]:
        """Yield each line as value name to text."""
        reader = csv.reader(self._file.text_lines(), strict=True)
        try:
            header = next(reader, [])
            columns = self._column_indices([name.strip() for name in header])
            for line in reader:
                if len(line) != len(header):
                    raise self._file.error(f"line {reader.line_num}", f"{len(line)} fields", f"{len(header)} fields")
                yield {name: line[column].strip() for name, column in columns.items()}
        except csv.Error as error:
            raise self._file.error(f"line {reader.line_num}", str(error), "comma-separated values") from error

    def _column_indices(self, header: list[str]) -> dict[str, int]:
        """Return value name to column of the table."""
        known = ("number", "time_utc", "slant_range_m", *_COORDINATES[self._config.positions], *NAVIGATION_LIMITS)
        for name, column in self._config.columns.items():
            if name not in known:
                raise SurveyFileError(str(self.path), "columns", name, "one of " + ", ".join(known))
            if column not in header:
                raise self._file.error("header", f"no {column!r}", f"the column that columns.{name} names")
        indices = {
            name: header.index(column) for name in known if (column := self._config.columns.get(name, name)) in header
        }
        for name in ("time_utc", "slant_range_m"):
            if name not in indices:
                raise self._file.error("header", f"no {name!r}", "a column of that name, or one in columns")
        return indices

    def _ping(self, row: int, values: dict[str, str], notes: PingNotes) -> Ping:
        slant_range_m = self._number(row, "slant_range_m", values)
        if slant_range_m is None or not 0 < slant_range_m <= MAX_SLANT_RANGE_M:
            raise self._file.error(
                f"ping {row}, slant_range_m", values["slant_range_m"], f"metres, above 0 to {MAX_SLANT_RANGE_M:.0f}"
            )
        navigation: dict[str, Any] = {name: self._plausible(row, name, values, notes) for name in NAVIGATION_LIMITS}
        if navigation["heading_deg"] == 360.0:
            navigation["heading_deg"] = 0.0
        position, grid_m = self._place(row, values)
        channels = tuple(
            ChannelPing(side, image[row].copy(), slant_range_m, self._config.frequency_hz)
            for side, image in self._images.items()
        )
        number = self._number(row, "number", values)
        return Ping(
            number=row if number is None or not 0 <= number < 2**63 else int(number),
            time_utc_s=self._time(row, values["time_utc"]),
            channels=channels,
            lat_deg=position.lat_deg if position else None,
            lon_deg=position.lon_deg if position else None,
            grid_m=grid_m,
            **navigation,
        )

    def _number(self, row: int, name: str, values: dict[str, str]) -> float | None:
        """Return a field as a number; None if it is absent, empty or not finite."""
        text = values.get(name, "")
        if not text:
            return None
        try:
            value = float(text)
        except ValueError as error:
            raise self._file.error(f"ping {row}, {name}", text, "a number or an empty field") from error
        return value if math.isfinite(value) else None

    def _plausible(self, row: int, name: str, values: dict[str, str], notes: PingNotes) -> float | None:
        value = self._number(row, name, values)
        if value is None or (value == 0 and (self._config.zero_is_unknown or name == "altitude_m")):
            return None
        if name == "speed_mps" and self._config.knots:
            value *= KNOT_MPS
        if is_plausible(name, value):
            return value
        notes.add(out_of_range(name), row)
        return None

    def _place(self, row: int, values: dict[str, str]) -> tuple[Position | None, tuple[float, float] | None]:
        """Return the position in degrees, and easting and northing of a table in metres."""
        north, east = (self._number(row, name, values) for name in _COORDINATES[self._config.positions])
        if north is None or east is None:
            return None, None
        if self._projection is None:
            return position_in_degrees(north, east), None
        return self._projection.position(east, north), grid_coordinates(east, north)

    def _time(self, row: int, text: str) -> float:
        try:
            seconds = float(text)
        except ValueError:
            seconds = self._iso_time(row, text)
        if not -6.2e10 < seconds < 2.5e11:
            raise self._file.error(f"ping {row}, time_utc", text, "a time of the years 1 to 9999")
        return seconds

    def _iso_time(self, row: int, text: str) -> float:
        try:
            when = datetime.fromisoformat(text)
            return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
        except (ValueError, OverflowError) as error:
            raise self._file.error(f"ping {row}, time_utc", text, "ISO 8601, or seconds since 1970") from error


def _read_description(path: Path) -> WaterfallDescription:
    with CheckedFile(path) as file:
        if file.size_bytes > _MAX_TOML_BYTES:
            raise file.error("file size", file.size_bytes, f"at most {_MAX_TOML_BYTES} bytes")
        try:
            return WaterfallDescription.model_validate(
                tomllib.loads(file.read_at(0, file.size_bytes, "file").decode("utf-8"))
            )
        except ValidationError as error:
            raise file.error(*first_error(error)) from error
        except (ValueError, RecursionError) as error:  # not UTF-8, or not TOML
            raise file.error("", str(error), "TOML") from error
