"""Options that the actions share."""

from __future__ import annotations

import argparse
from datetime import UTC, datetime
from pathlib import Path

from sonarpost.sonar.options import SurveyOptions, load_options


def add_option_flags(parser: argparse.ArgumentParser) -> None:
    """Add what says how a file is to be understood."""
    parser.add_argument(
        "--options", type=Path, metavar="FILE.toml", help="mounting, errors, projection (docs/explanation/surveys.md)"
    )
    parser.add_argument("--crs", metavar="EPSG:N", help="what positions in metres are in; goes before the options file")


def options_of(parsed: argparse.Namespace) -> SurveyOptions:
    """Return the survey options that the command line asks for.

    Raises:
        ConfigError: The options file is wrong.
    """
    options = load_options(parsed.options) if parsed.options is not None else SurveyOptions()
    return options if parsed.crs is None else options.model_copy(update={"projected_crs": parsed.crs})


def utc_text(time_utc_s: float) -> str:
    """Return a time as ISO 8601 to the millisecond."""
    when = datetime.fromtimestamp(round(time_utc_s, 3), tz=UTC)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")
