"""Options and texts that the actions share."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path

from sonarpost.sonar.options import SurveyOptions, load_options


def add_option_flags(parser: argparse.ArgumentParser) -> None:
    """Add the options for the interpretation of a file."""
    parser.add_argument(
        "--options", type=Path, metavar="FILE.toml", help="mounting, errors, projection (see the page Surveys)"
    )
    parser.add_argument("--crs", metavar="EPSG:N", help="coordinate system of positions in metres; overrides the file")


def options_of(parsed: argparse.Namespace) -> SurveyOptions:
    """Return the survey options of the command line.

    Raises:
        ConfigError: The options file is invalid.
    """
    options = load_options(parsed.options) if parsed.options is not None else SurveyOptions()
    return options if parsed.crs is None else options.model_copy(update={"projected_crs": parsed.crs})


def utc_text(time_utc_s: float) -> str:
    """Return a time as ISO 8601 to the millisecond."""
    when = datetime.fromtimestamp(round(time_utc_s, 3), tz=UTC)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")
