"""`sonarpost survey plot FILE…`: the waterfall with a range scale and the track, as PNG."""

from __future__ import annotations

import argparse
import io
from pathlib import Path

from PIL import Image

from sonarpost.cli.survey.common import add_option_flags, options_of
from sonarpost.cli.survey.track_picture import draw_track, thinned_track
from sonarpost.cli.survey.waterfall_picture import MAX_ROWS, draw_waterfall, evened, reduce_survey
from sonarpost.errors import ConfigError
from sonarpost.files import write_atomically
from sonarpost.sonar.readers.registry import open_survey

_MOST_ROWS = 20_000


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser(
        "plot",
        help="draw waterfalls and tracks",
        description="Write NAME-waterfall.png and NAME-track.png for every survey file NAME.",
    )
    parser.add_argument("files", nargs="+", type=Path, metavar="FILE", help="survey file")
    parser.add_argument("--out", type=Path, default=Path(), metavar="DIR", help="folder for the pictures (default: .)")
    parser.add_argument("--ground", action="store_true", help="without the water column, over ground range")
    parser.add_argument("--even", action="store_true", help="with --ground: divided by the mean echo of its angle")
    parser.add_argument(
        "--rows", type=int, default=MAX_ROWS, metavar="N", help="pings are averaged to fit (default: %(default)s)"
    )
    add_option_flags(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Draw every file; print the names of the pictures; return 0.

    Raises:
        SurveyFileError: A file cannot be read.
        ConfigError: The options file or the number of rows is wrong.
        OSError: A picture cannot be written.
    """
    if not 1 <= parsed.rows <= _MOST_ROWS:
        raise ConfigError("survey plot", "--rows", parsed.rows, f"1 to {_MOST_ROWS}")
    if parsed.even and not parsed.ground:
        raise ConfigError("survey plot", "--even", "without --ground", "--ground, which knows the angles")
    options = options_of(parsed)
    for path in parsed.files:
        with open_survey(path, options) as source:
            name = source.info.line_name
            title = f"{name}   {source.info.sonar_id}   {source.info.ping_count} pings"
            reduced = reduce_survey(source, over_ground=parsed.ground, max_rows=parsed.rows)
            if parsed.even:
                reduced = evened(reduced)
            pictures = {
                "waterfall": draw_waterfall(reduced, title, over_ground=parsed.ground),
                "track": draw_track(thinned_track(source.pings()), title),
            }
        for kind, picture in pictures.items():
            target = parsed.out / f"{name}-{kind}.png"
            write_atomically(target, _png(picture))
            print(target)
    return 0


def _png(picture: Image.Image) -> bytes:
    buffer = io.BytesIO()
    picture.save(buffer, format="PNG")
    return buffer.getvalue()
