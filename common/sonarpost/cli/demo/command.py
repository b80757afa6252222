"""The `sonarpost demo` command."""

from __future__ import annotations

import argparse
import logging
import shutil
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from sonarpost.cli.demo.chain import Chain
from sonarpost.cli.demo.operator_page import OperatorPage
from sonarpost.cli.demo.outcome import evaluate
from sonarpost.cli.demo.report import show
from sonarpost.cli.demo.settings import ChainSettings, free_ports
from sonarpost.cli.demo.watch import Watcher
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.modem.micromodem import RATES
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.readers import SUPPORTED_SUFFIXES
from sonarpost.sonar.survey import Survey
from sonarpost.sonar.xtf_writer import write_xtf

MARKER = ".sonarpost-demo"
QUIET_S = 1.5
"""Real time without a change after which an idle chain has finished."""
STALLED_S = 60.0
"""Real time without a change after which the demo ends although the chain is busy."""
MAX_FEEDBACK_INTERVALS = 60
"""Feedback intervals without a change, on top of `STALLED_S`, while the vessel still repeats feedback."""
IMAGE_SUFFIXES = (".tif", ".tiff", ".png")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "demo",
        help="run the whole chain on this host, from a survey file to the shore",
        description="Run every service as a process, with emulated acoustic modems on pseudo-terminals, three Zenoh "
        "routers, and a simulated or given survey. Ends with a table and a contact sheet. The exit status is 1 if an "
        "image that the channel can deliver is missing or incomplete at the shore site.",
    )
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--survey", type=Path, metavar="FILE_OR_DIR", help="survey file, or a folder of them")
    source.add_argument("--images", type=Path, metavar="DIR", help="send the TIFF and PNG snippets of a folder instead")
    parser.add_argument("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="output (default: demo-out)")
    link = parser.add_mutually_exclusive_group()
    link.add_argument(
        "--link",
        choices=("v1", "paper"),
        default="v1",
        help="wire format: v1 with the codec emb, or the paper's with its tile codec (default: %(default)s)",
    )
    link.add_argument("--paper", action="store_const", const="paper", dest="link", help="short for --link paper")
    parser.add_argument("--rate", type=int, default=1, choices=sorted(RATES), help="Micro-Modem rate (default: 1)")
    parser.add_argument("--loss", type=_probability, default=0.0, metavar="P", help="probability that a frame is lost")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="seed of the survey and channel simulators")
    parser.add_argument(
        "--time-scale", type=_positive, default=20.0, metavar="X", help="simulated seconds per second (default: 20)"
    )
    parser.add_argument(
        "--console", action="store_true", help="serve the operator's page and keep it open at the end until Ctrl-C"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object as the last line")
    parser.set_defaults(run=run)


def _probability(text: str) -> float:
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text}: expected 0 to 1")
    return value


def _positive(text: str) -> float:
    value = float(text)
    if not 0.1 <= value <= 1000:
        raise argparse.ArgumentTypeError(f"{text}: expected 0.1 to 1000")
    return value


def run(parsed: argparse.Namespace) -> int:
    """Run the demo; return 0 if everything that the channel can deliver is at the shore site, unchanged."""
    console = Console(stderr=True)
    # Routers and services start together: failed first attempts to connect are expected.
    logging.getLogger("sonarpost.bus.session").setLevel(logging.ERROR)
    started = time.monotonic()
    inputs = _inputs(parsed)
    folder = _fresh_folder(parsed.out)
    simulated = _simulate(parsed.seed, console) if inputs is None else None
    ports = free_ports(4)
    settings = ChainSettings(
        folder=folder,
        mode="snippets" if parsed.images else "survey",
        link=parsed.link,
        rate=parsed.rate,
        loss=parsed.loss,
        seed=parsed.seed,
        time_scale=parsed.time_scale,
        router_ports=(ports[0], ports[1], ports[2]),
        console_port=ports[3] if parsed.console else None,
    )
    page = OperatorPage(settings) if parsed.console else None
    with Chain(settings) as chain, Watcher(settings) as watcher:
        # During the start of the services: the vehicle processes files when it is ready.
        files = _deposit(inputs, simulated, settings, console)
        with console.status("starting three routers and eight services"):
            watcher.wait_until_started(chain.check)
        if page is not None:
            page.show(console)
        _follow(chain, watcher, files, console)
        if page is not None:
            page.keep_open(chain, console)
    outcome = evaluate(settings, watcher.snippets, watcher.contact_of_image, time.monotonic() - started)
    show(watcher, settings, outcome, console)
    if parsed.json:
        print(outcome.as_json(), flush=True)
    refused = _print_refused(settings, console)
    return 0 if outcome.succeeded and refused < files else 1


def _inputs(parsed: argparse.Namespace) -> tuple[Path, ...] | None:
    """Return the files to process, None for a simulated survey.

    Raises:
        SurveyFileError: There is no such file or folder, or no suitable file in it.
    """
    given: Path | None = parsed.survey or parsed.images
    if given is None:
        return None
    suffixes = IMAGE_SUFFIXES if parsed.images else SUPPORTED_SUFFIXES
    if given.is_file() and not parsed.images:
        return (given,)
    if not given.is_dir():
        raise SurveyFileError(str(given), "", "no such file or folder", "a file or folder that exists")
    found = tuple(sorted(p for p in given.iterdir() if p.suffix.lower() in suffixes and p.is_file()))
    if not found:
        raise SurveyFileError(str(given), "", "no such file in it", "files named *" + ", *".join(suffixes))
    return found


def _fresh_folder(folder: Path) -> Path:
    """Return the folder, new or emptied.

    Raises:
        ConfigError: The folder is not empty and not of an earlier demo.
    """
    folder = folder.absolute()
    if folder.exists() and (not folder.is_dir() or (any(folder.iterdir()) and not (folder / MARKER).is_file())):
        raise ConfigError("--out", "", str(folder), "a folder that is new, empty or of an earlier demo")
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    (folder / MARKER).touch()
    return folder


def _print_refused(settings: ChainSettings, console: Console) -> int:
    """Print which input files were refused, with the reason; return their number."""
    reasons = sorted((settings.incoming / "quarantine").glob("*.reason.txt"))
    for path in reasons:
        console.print(f"[red]refused:[/red] {path.read_text(encoding='utf-8').strip()}", soft_wrap=True)
    return len(reasons)


def _simulate(seed: int, console: Console) -> Survey:
    """Return a simulated survey; print what it holds."""
    with console.status("simulating a survey of 1000 pings"):
        simulated = simulate_survey(SurveySpec(seed=seed, seabed=SeabedKind.SAND, targets=6, clutter=6))
    mines = sum(truth.is_mine_like for truth in simulated.truth)
    console.print(
        f"simulated survey of {len(simulated.survey.pings)} pings over sand: "
        f"{mines} mine-like objects, {len(simulated.truth) - mines} others"
    )
    return simulated.survey


def _deposit(
    inputs: tuple[Path, ...] | None, simulated: Survey | None, settings: ChainSettings, console: Console
) -> int:
    """Put the input files into the folder that the vehicle polls; return their number."""
    if simulated is not None:
        write_xtf(simulated, settings.incoming / f"simulated-{settings.seed}.xtf")
        return 1
    assert inputs is not None
    for path in inputs:
        partial = settings.incoming / f".{path.name}"
        shutil.copyfile(path, partial)
        partial.rename(settings.incoming / path.name)
    console.print(f"{len(inputs)} input file{'s' if len(inputs) != 1 else ''}")
    return len(inputs)


def _follow(chain: Chain, watcher: Watcher, files: int, console: Console) -> None:
    """Show progress until the chain has finished, or nothing has changed for too long."""
    settings = chain.settings
    airtime_s = RATES[settings.rate].airtime_s
    stalled_s = STALLED_S + 10 * settings.packet_s + MAX_FEEDBACK_INTERVALS * settings.feedback_interval_s
    columns = (
        TextColumn("{task.description:<24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]}"),
    )
    with Progress(*columns, TimeElapsedColumn(), console=console) as progress:
        air = progress.add_task("acoustic airtime", total=None, unit="s")
        shore = progress.add_task("images at the shore site", total=None, unit="")
        changes, changed_at, idle_since = -1, time.monotonic(), None
        while True:
            chain.check()
            now = time.monotonic()
            planned, sent = watcher.packets_planned, watcher.packets_sent
            progress.update(air, total=round(planned * airtime_s) or None, completed=round(sent * airtime_s))
            progress.update(shore, total=len(watcher.encoded) or None, completed=len(watcher.shore))
            busy = watcher.busy(files, time.time() - 5.0)
            if watcher.changes != changes:
                changes, changed_at, idle_since = watcher.changes, now, None
            if busy:
                idle_since = None
                if now - changed_at > stalled_s:
                    console.print(f"[red]no change for {stalled_s:.0f} s; still busy: {busy}")
                    return
            elif idle_since is None:
                idle_since = now
            elif now - idle_since > QUIET_S + settings.packet_s:
                return
            time.sleep(0.1)
