"""`sonarpost survey view FILE`: serve a page with the waterfall, its contacts, and picks by a click."""

import argparse
import secrets
import tempfile
import threading
from dataclasses import replace
from pathlib import Path
from typing import Final

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import add_survey_options, in_new_folder, option, print_notes, survey_options_of
from sonarpost.detection.detector import Detection
from sonarpost.detection.picks import Pick, locate_picks, parse_picks, picks_path
from sonarpost.detection.settings import DetectorSettings, checked_settings, load_settings
from sonarpost.detection.stream import FileOrigin, PingOrigin, StreamDetector
from sonarpost.errors import ConfigError, SonarpostError
from sonarpost.extensions.survey_view.waterfall import Waterfall
from sonarpost.sonar.options import SurveyOptions
from sonarpost.sonar.readers import open_survey
from sonarpost.sonar.source import SurveySource
from sonarpost.sonar.survey import Survey
from sonarpost.stop_signals import stop_on_signals

HOST: Final = "127.0.0.1"
_WAIT_S: Final = 0.5


def add_options(parser: CommandParser) -> None:
    """Add the action."""
    parser.description = (
        "Serve a page on this host with the waterfall and its contacts. A click picks a contact that the "
        "detector has missed; Save writes the picks for the vehicle and shows the command that lists them."
    )
    option(parser, "file FILE", "survey file", Path)
    option(parser, "--out FILE.picks", "file of picks (default: the survey file's name and .picks)", Path)
    option(parser, "--port", f"port on {HOST} (default: any free port)", int, 0)
    option(parser, "--threshold CONFIDENCE", "as for `sonarpost detect` (default: 1.0)", float)
    option(parser, "--settings FILE.toml", "settings of the detector, as for `sonarpost detect`", Path)
    add_survey_options(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Serve the page until SIGINT or SIGTERM; return 0.

    Raises:
        ConfigError: An option or the file of picks is invalid.
        SurveyFileError: The recording cannot be read.
        PortError: The port is in use.
    """
    # Imported lazily: they need the extra `console`.
    from sonarpost.extensions.survey_view.web import DetectedContacts, SurveyViewApp  # noqa: PLC0415
    from sonarpost.services.console.web.server import WebServer  # noqa: PLC0415

    if not 0 <= parsed.port <= 65535:
        raise ConfigError("survey view", "--port", parsed.port, "0 to 65535")
    settings = _settings(parsed)
    options = survey_options_of(parsed)
    path: Path = parsed.file
    out: Path = parsed.out if parsed.out is not None else picks_path(path)
    with tempfile.TemporaryDirectory(prefix="sonarpost-view-") as folder:
        with ProgressDisplay(step=f"drawing {path}"), open_survey(path, options) as source:
            print_notes(source.info)
            in_new_folder(out)
            picks = stored_picks(source, out)
            waterfall = Waterfall(source, Path(folder))
            info = source.info
        contacts = DetectedContacts()
        token = secrets.token_urlsafe(16)
        app = SurveyViewApp(info, waterfall, contacts, picks, out, _detect_command(parsed), token)
        server = WebServer(app.asgi, HOST, parsed.port)

        def detect() -> None:
            try:
                contacts.finish(detected(path, options, settings))
            except (SonarpostError, OSError) as error:
                contacts.fail(str(error))
            except Exception as error:
                contacts.fail(f"{type(error).__name__}: {error}")
                raise

        # A daemon: the command does not wait for it when it ends.
        threading.Thread(target=detect, name="detect", daemon=True).start()
        with stop_on_signals() as stop:
            server.start()
            try:
                print(f"{server.address}{token}/")
                print(f"{path}: {info.ping_count} pings; picks: {out}. Ctrl-C ends the page.", flush=True)
                while server.running and not stop.wait(_WAIT_S):
                    pass
            finally:
                server.stop()
    return 0


def _settings(parsed: argparse.Namespace) -> DetectorSettings:
    settings = DetectorSettings() if parsed.settings is None else load_settings(parsed.settings)
    changes = {} if parsed.threshold is None else {"confidence_threshold": parsed.threshold}
    return checked_settings(settings.model_dump() | changes, "survey view")


def _detect_command(parsed: argparse.Namespace) -> list[str]:
    """Return the `sonarpost detect` with the options of this call."""
    options = {
        "--settings": parsed.settings,
        "--threshold": parsed.threshold,
        "--options": parsed.options,
        "--crs": parsed.crs,
    }
    given = [part for name, value in options.items() if value is not None for part in (name, str(value))]
    return ["sonarpost", "detect", str(parsed.file), *given]


def stored_picks(source: SurveySource, path: Path) -> list[tuple[Pick, int]]:
    """Return the picks of an existing file, each with the index of its ping; none without the file.

    Raises:
        ConfigError: A line is no pick of this recording. Save would remove it.
        SurveyFileError: The recording cannot be read.
        OSError: The file cannot be read.
    """
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return []
    picks, errors = parse_picks(content, str(path))
    located, outside = locate_picks(source, picks, str(path))
    for error in (*errors, *outside):
        raise error
    return [(each.pick, each.row) for each in located]


def detected(path: Path, options: SurveyOptions, settings: DetectorSettings) -> list[Detection]:
    """Return the contacts of a file; their ping indices are those of the file.

    Raises:
        SurveyFileError: The file cannot be read.
    """

    def in_file(_survey: Survey, detection: Detection, origin: PingOrigin) -> Detection:
        first, end = (row + origin.row - detection.ping_index for row in detection.highlight_pings)
        return replace(detection, ping_index=origin.row, highlight_pings=(first, end))

    detector = StreamDetector(in_file, settings)
    with open_survey(path, options) as source:
        found = detector.add_file(source, FileOrigin.of(source, ""))
    return [contact.content for contact in (*found.contacts, *detector.finish())]
