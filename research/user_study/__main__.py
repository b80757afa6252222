"""`python -m research.user_study`: serve the user study, or print its results."""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from research.common.command import command_parser, run_command
from research.user_study.server import Answers, Folders, StudyApp
from research.user_study.trials import results, table
from sonarpost.errors import ConfigError
from sonarpost.services.console.web.server import WebServer
from sonarpost.stop_signals import stop_on_signals

FILE_NAME = "panel.db"


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser(
        "user_study", "Measure how well people recognise decoded images: blind forced choice among originals."
    )
    parser.add_argument("--originals", type=Path, metavar="DIR", help="original images (PNG, TIFF)")
    parser.add_argument(
        "--decoded",
        type=Path,
        metavar="DIR",
        help="decoded images of the same names, or one folder a group",
    )
    parser.add_argument(
        "--state", type=Path, default=Path("panel"), metavar="DIR", help="folder of the answers (default: panel)"
    )
    parser.add_argument("--choices", type=int, default=4, metavar="N", help="originals in a trial (default: 4)")
    parser.add_argument("--title", default="Which original is it?", help="title of the page")
    parser.add_argument("--seed", type=int, default=1, help="seed of the order (default: 1)")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, default=8472, help="default: 8472; 0: any")
    parser.add_argument("--results", action="store_true", help="print the results and exit")
    parser.add_argument("--json", action="store_true", help="results as JSON")
    return parser


def run(parsed: argparse.Namespace) -> int:
    """Serve the study until it is stopped, or print its results; return the exit status.

    Raises:
        ConfigError: A folder or number is invalid.
        DeliveryError: The answers cannot be opened.
        PortError: The address is not available.
    """
    if parsed.results:
        return _print_results(parsed.state / FILE_NAME, as_json=parsed.json)
    if parsed.originals is None or parsed.decoded is None:
        raise ConfigError("user_study", "", "nothing", "--originals DIR and --decoded DIR, or --results")
    folders = Folders.read(parsed.originals, parsed.decoded)
    answers = Answers(parsed.state / FILE_NAME)
    try:
        app = StudyApp(folders, answers, parsed.title, parsed.choices, parsed.seed, parsed.host)
        server = WebServer(app.asgi, parsed.host, parsed.port)
        print(f"{server.address}panel  {len(folders.decoded)} images", flush=True)
        _serve(server)
    finally:
        answers.close()
    return 0


def _print_results(path: Path, *, as_json: bool) -> int:
    if not path.is_file():
        raise ConfigError("user_study", "--state", str(path.parent), f"a folder with {FILE_NAME}")
    answers = Answers(path)
    try:
        choices = int(answers.setting("choices", b"4"))
        found = results(answers.all(), choices)
    finally:
        answers.close()
    print(json.dumps(found, indent=1) if as_json else table(found))
    return 0


def _serve(server: WebServer) -> None:
    with stop_on_signals() as stop:
        server.start()
        try:
            while server.running and not stop.wait(0.5):
                pass
        finally:
            server.stop()


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return the exit status."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
