"""Reader of a survey as pictures and a table: `NAME.waterfall.toml` names them and says what they hold.

    sonar_id = "my sonar"
    port = "line.port.png"               # row = ping, column = sample; grey TIFF or PNG of 8 or 16 bits
    starboard = "line.stbd.png"
    port_order = "farthest_first"        # or nearest_first: nothing is guessed from the picture
    navigation = "line.csv"              # a header line, then one line a ping
    positions = "degrees"                # or "metres", with projected_crs here or in the options
    [columns]                            # what the table calls the values; those of the same name may be left out
    lat_deg = "y_or_lat"

Columns are `time_utc` (ISO 8601 or seconds since 1970) and `slant_range_m`, which every line has, and `number`,
`lat_deg`, `lon_deg` (or `easting_m`, `northing_m`), `heading_deg`, `altitude_m`, `depth_m`, `speed_mps`, `pitch_deg`,
`roll_deg`, where an empty field is not known. Pictures are decoded whole, so they are held to `image_files`' size
limits; the table is read line by line.
"""

from __future__ import annotations

import csv
import math
import tomllib
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sonarpost.errors import SurveyFileError
from sonarpost.sonar.geometry import Position
from sonarpost.sonar.image_files import GreyImage, read_image
from sonarpost.sonar.navigation import NavigationRows, Projection
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers.open_file import CheckedFile
from sonarpost.sonar.source import StreamedSource
from sonarpost.sonar.survey import MAX_SLANT_RANGE_M, ChannelPing, Ping, Side

_MAX_TOML_BYTES: Final = 1 << 16
_RANGES: Final = {
    "heading_deg": (0.0, 360.0),
    "altitude_m": (0.0, 11_000.0),
    "depth_m": (-100.0, 11_000.0),
    "speed_mps": (0.0, 50.0),
    "pitch_deg": (-90.0, 90.0),
    "roll_deg": (-180.0, 180.0),
}
_COORDINATES: Final = {"degrees": ("lat_deg", "lon_deg"), "metres": ("northing_m", "easting_m")}
_Name = Annotated[str, Field(min_length=1, max_length=255)]


class WaterfallDescription(BaseModel):
    """The fields of a `.waterfall.toml`; see the module's text."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    sonar_id: str = "unknown"
    port: _Name | None = None
    starboard: _Name | None = None
    port_order: Literal["farthest_first", "nearest_first"] | None = None
    navigation: _Name
    positions: Literal["degrees", "metres"]
    projected_crs: str | None = None
    frequency_hz: Annotated[float, Field(gt=0)] | None = None
    knots: bool = False
    zero_is_unknown: bool = False
    columns: dict[str, _Name] = Field(default_factory=dict)


class WaterfallSource(StreamedSource):
    """An open waterfall survey.

    Raises:
        SurveyFileError: One of its files is missing or damaged, or they do not fit each other.
    """

    def __init__(self, path: Path, options: SurveyOptions) -> None:
        super().__init__(path, options)
        self._file = _description(path)
        if self._file.port is not None and self._file.port_order is None:
            raise SurveyFileError(str(path), "port_order", None, "farthest_first or nearest_first")
        crs = self._file.projected_crs or options.projected_crs
        if self._file.positions == "metres" and crs is None:
            raise SurveyFileError(str(path), "projected_crs", None, "the coordinate system of positions in metres")
        self._projection = Projection(crs, path) if crs is not None and self._file.positions == "metres" else None
        self._pictures = self._read_pictures()
        self._table = CheckedFile(path.parent / self._file.navigation)
        self._without_fix = NavigationRows()
        self._odd: dict[str, NavigationRows] = {}
        self._pings = 0
        try:
            self._scan(self._file.sonar_id, path.name.removesuffix(".toml").removesuffix(".waterfall"))
        except BaseException:
            self._table.close()
            raise

    def close(self) -> None:
        """Close the table."""
        self._table.close()

    def _read_pictures(self) -> dict[Side, GreyImage]:
        named = {Side.PORT: self._file.port, Side.STARBOARD: self._file.starboard}
        pictures = {side: read_image(self.path.parent / name) for side, name in named.items() if name is not None}
        if not pictures:
            raise SurveyFileError(str(self.path), "port, starboard", None, "the picture of at least one side")
        if self._file.port_order == "farthest_first" and Side.PORT in pictures:
            pictures[Side.PORT] = pictures[Side.PORT][:, ::-1]
        return pictures

    def _notes(self) -> list[str]:
        fixes = [f"no position fix in {self._without_fix.of(self._pings)}"] if self._without_fix.count else []
        return fixes + [f"{name} out of range in {rows.of(self._pings)}" for name, rows in sorted(self._odd.items())]

    def _walk(self, *, first: bool) -> Iterator[Ping]:
        count = -1
        for count, values in enumerate(self._lines()):
            if any(count >= picture.shape[0] for picture in self._pictures.values()):
                break
            yield self._ping(count, values, first=first)
        self._pings = count + 1
        for side, picture in self._pictures.items():
            if picture.shape[0] != self._pings:
                expected = f"a table of {picture.shape[0]} lines, as the {side.value} picture has rows"
                raise self._table.error("lines", self._pings, expected)
        self._table.check_unchanged()

    def _lines(self) -> Iterator[dict[str, str]]:
        """Yield each line as our names to texts."""
        reader = csv.reader(self._table.text_lines(), strict=True)
        try:
            header = next(reader, [])
            places = self._places([name.strip() for name in header])
            for line in reader:
                if len(line) != len(header):
                    raise self._table.error(f"line {reader.line_num}", f"{len(line)} fields", f"{len(header)} fields")
                yield {name: line[place].strip() for name, place in places.items()}
        except csv.Error as error:
            raise self._table.error(f"line {reader.line_num}", str(error), "comma-separated values") from error

    def _places(self, header: list[str]) -> dict[str, int]:
        """Return our names to columns of the table."""
        known = ("number", "time_utc", "slant_range_m", *_COORDINATES[self._file.positions], *_RANGES)
        for name, column in self._file.columns.items():
            if name not in known:
                raise SurveyFileError(str(self.path), "columns", name, "one of " + ", ".join(known))
            if column not in header:
                raise self._table.error("header", f"no {column!r}", f"the column that columns.{name} names")
        places = {
            name: header.index(column) for name in known if (column := self._file.columns.get(name, name)) in header
        }
        for name in ("time_utc", "slant_range_m"):
            if name not in places:
                raise self._table.error("header", f"no {name!r}", "a column of that name, or one in columns")
        return places

    def _ping(self, row: int, values: dict[str, str], *, first: bool) -> Ping:
        slant_range_m = self._number(row, "slant_range_m", values)
        if slant_range_m is None or not 0 < slant_range_m <= MAX_SLANT_RANGE_M:
            raise self._table.error(
                f"ping {row}, slant_range_m", values["slant_range_m"], f"metres, above 0 to {MAX_SLANT_RANGE_M:.0f}"
            )
        navigation = {name: self._in_range(row, name, values, first=first) for name in _RANGES}
        if navigation["heading_deg"] == 360.0:
            navigation["heading_deg"] = 0.0
        place = self._position(row, values)
        if place is None and first:
            self._without_fix.add(row)
        channels = tuple(
            ChannelPing(side, picture[row].copy(), slant_range_m, self._file.frequency_hz)
            for side, picture in self._pictures.items()
        )
        number = self._number(row, "number", values)
        return Ping(
            number=row if number is None or not 0 <= number < 2**63 else int(number),
            time_utc_s=self._time(row, values["time_utc"]),
            channels=channels,
            lat_deg=place.lat_deg if place else None,
            lon_deg=place.lon_deg if place else None,
            **navigation,
        )

    def _number(self, row: int, name: str, values: dict[str, str]) -> float | None:
        """Return a field as a number; None where it is absent, empty or not finite."""
        text = values.get(name, "")
        if not text:
            return None
        try:
            value = float(text)
        except ValueError as error:
            raise self._table.error(f"ping {row}, {name}", text, "a number, or nothing") from error
        return value if math.isfinite(value) else None

    def _in_range(self, row: int, name: str, values: dict[str, str], *, first: bool) -> float | None:
        value = self._number(row, name, values)
        if value is None or (value == 0 and (self._file.zero_is_unknown or name == "altitude_m")):
            return None
        if name == "speed_mps" and self._file.knots:
            value *= 1852 / 3600
        low, high = _RANGES[name]
        if low <= value <= high:
            return value
        if first:
            self._odd.setdefault(name, NavigationRows()).add(row)
        return None

    def _position(self, row: int, values: dict[str, str]) -> Position | None:
        north, east = (self._number(row, name, values) for name in _COORDINATES[self._file.positions])
        if north is None or east is None or (north, east) == (0.0, 0.0):
            return None
        if self._projection is not None:
            return self._projection.position(east, north)
        return Position(north, east) if abs(north) <= 90 and abs(east) <= 180 else None

    def _time(self, row: int, text: str) -> float:
        try:
            seconds = float(text)
        except ValueError:
            seconds = self._iso_time(row, text)
        if not -6.2e10 < seconds < 2.5e11:
            raise self._table.error(f"ping {row}, time_utc", text, "a time of the years 1 to 9999")
        return seconds

    def _iso_time(self, row: int, text: str) -> float:
        try:
            when = datetime.fromisoformat(text)
            return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()
        except (ValueError, OverflowError) as error:
            raise self._table.error(f"ping {row}, time_utc", text, "ISO 8601, or seconds since 1970") from error


def _description(path: Path) -> WaterfallDescription:
    with CheckedFile(path) as file:
        if file.size_bytes > _MAX_TOML_BYTES:
            raise file.error("file size", file.size_bytes, f"at most {_MAX_TOML_BYTES} bytes")
        try:
            return WaterfallDescription.model_validate(
                tomllib.loads(file.read_at(0, file.size_bytes, "file").decode("utf-8"))
            )
        except ValidationError as error:
            first = error.errors()[0]
            field = ".".join(str(part) for part in first["loc"])
            raise file.error(field, first["input"], first["msg"]) from error
        except (ValueError, RecursionError) as error:  # not UTF-8, or not TOML
            raise file.error("", str(error), "TOML") from error
