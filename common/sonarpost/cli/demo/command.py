"""The `sonarpost demo` command."""

from __future__ import annotations

import argparse
import logging
import shutil
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from sonarpost.cli.demo.account import settle
from sonarpost.cli.demo.chain import Chain
from sonarpost.cli.demo.page import Page
from sonarpost.cli.demo.report import show
from sonarpost.cli.demo.settings import ChainSettings, free_ports
from sonarpost.cli.demo.watch import Watcher
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.modem.micromodem import RATES
from sonarpost.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.simulation.seabed.terrain import SeabedKind
from sonarpost.sonar.readers import SUPPORTED_SUFFIXES
from sonarpost.sonar.xtf_writer import write_xtf

MARKER = ".sonarpost-demo"
QUIET_S = 1.5
STALLED_S = 60.0
PICTURE_SUFFIXES = (".tif", ".tiff", ".png")


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand."""
    parser = subparsers.add_parser(
        "demo",
        help="run the whole chain on this host, from a survey file to the shore",
        description="Run every service as a process, with emulated acoustic modems on pseudo-terminals, three Zenoh "
        "routers, and a survey (simulated unless one is given). Ends with a table and a contact sheet.",
    )
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--survey", type=Path, metavar="FILE_OR_DIR", help="survey file, or a folder of them")
    source.add_argument("--images", type=Path, metavar="DIR", help="send the TIFF and PNG pictures of a folder instead")
    parser.add_argument("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="(default %(default)s)")
    parser.add_argument(
        "--link",
        choices=("v1", "paper"),
        default="paper",
        help="wire format: v1 with the codec emb, or the paper's with its tile codec (default %(default)s)",
    )
    parser.add_argument("--rate", type=int, default=1, choices=sorted(RATES), help="Micro-Modem rate (default 1)")
    parser.add_argument("--loss", type=_probability, default=0.0, metavar="P", help="probability of losing a frame")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="of the simulated survey and the water")
    parser.add_argument(
        "--time-scale", type=_positive, default=20.0, metavar="X", help="simulated seconds a second (default 20)"
    )
    parser.add_argument(
        "--console", action="store_true", help="serve the operator's page, and leave it open afterwards until Ctrl-C"
    )
    parser.add_argument("--json", action="store_true", help="end with one JSON object on the last line")
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
    """Run the demo; return 0 when everything the water let through is ashore, unchanged."""
    console = Console(stderr=True)
    # The routers start at the same time as those who look for them; that they are not there at once is no news.
    logging.getLogger("sonarpost.bus.session").setLevel(logging.ERROR)
    started = time.monotonic()
    inputs = _inputs(parsed)
    folder = _fresh_folder(parsed.out)
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
    page = Page(settings) if parsed.console else None
    with Chain(settings) as chain, Watcher(settings) as watcher:
        with console.status("starting three routers and eight services"):
            watcher.wait_until_started(chain.check)
        if page is not None:
            page.show(console)
        files = _deposit(inputs, settings, parsed.seed, console)
        _follow(chain, watcher, files, console)
        if page is not None:
            page.leave_open(chain, console)
    result = settle(settings, len(watcher.snippets), time.monotonic() - started)
    show(watcher, settings, result, console)
    if parsed.json:
        print(result.as_json(), flush=True)
    refused = _refused(settings, console)
    return 0 if not result.missing_ashore and result.sha256_match and refused < files else 1


def _inputs(parsed: argparse.Namespace) -> tuple[Path, ...] | None:
    """Return the files to process, None for a simulated survey.

    Raises:
        SurveyFileError: There are none.
    """
    given: Path | None = parsed.survey or parsed.images
    if given is None:
        return None
    suffixes = PICTURE_SUFFIXES if parsed.images else SUPPORTED_SUFFIXES
    if given.is_file() and not parsed.images:
        return (given,)
    if not given.is_dir():
        raise SurveyFileError(str(given), "", "no such file or folder", "a file or folder that exists")
    found = tuple(sorted(p for p in given.iterdir() if p.suffix.lower() in suffixes and p.is_file()))
    if not found:
        raise SurveyFileError(str(given), "", "no such file in it", "files named *" + ", *".join(suffixes))
    return found


def _fresh_folder(folder: Path) -> Path:
    """Empty a folder of an earlier demo; never one that holds anything else.

    Raises:
        ConfigError: The folder holds something that no demo has made.
    """
    folder = folder.absolute()
    if folder.exists() and (not folder.is_dir() or (any(folder.iterdir()) and not (folder / MARKER).is_file())):
        raise ConfigError("--out", "", str(folder), "a folder that is new, empty or of an earlier demo")
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    (folder / MARKER).touch()
    return folder


def _refused(settings: ChainSettings, console: Console) -> int:
    """Say which input files were put aside and why; return how many."""
    reasons = sorted((settings.incoming / "quarantine").glob("*.reason.txt"))
    for path in reasons:
        console.print(f"[red]refused:[/red] {path.read_text(encoding='utf-8').strip()}", soft_wrap=True)
    return len(reasons)


def _deposit(inputs: tuple[Path, ...] | None, settings: ChainSettings, seed: int, console: Console) -> int:
    """Put the input where the vehicle polls, as its own recorder would; return how many files."""
    if inputs is None:
        with console.status("simulating a survey of 1000 pings"):
            simulated = simulate_survey(SurveySpec(seed=seed, seabed=SeabedKind.SAND, targets=6, clutter=6))
        write_xtf(simulated.survey, settings.incoming / f"simulated-{seed}.xtf")
        mines = sum(truth.is_mine_like for truth in simulated.truth)
        console.print(
            f"simulated survey of {len(simulated.survey.pings)} pings over sand: "
            f"{mines} mine-like objects, {len(simulated.truth) - mines} others"
        )
        return 1
    for path in inputs:
        partial = settings.incoming / f".{path.name}"
        shutil.copyfile(path, partial)
        partial.rename(settings.incoming / path.name)
    console.print(f"{len(inputs)} input file{'s' if len(inputs) != 1 else ''}")
    return len(inputs)


def _follow(chain: Chain, watcher: Watcher, files: int, console: Console) -> None:
    """Show progress until the chain has nothing left to do, or nothing has changed for a minute."""
    airtime_s = RATES[chain.settings.rate].airtime_s
    columns = (
        TextColumn("{task.description:<22}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]}"),
    )
    with Progress(*columns, TimeElapsedColumn(), console=console) as progress:
        air = progress.add_task("acoustic air time", total=None, unit="s")
        shore = progress.add_task("pictures ashore", total=None, unit="")
        changes, changed_at, quiet_since = -1, time.monotonic(), None
        while True:
            chain.check()
            now = time.monotonic()
            planned, sent = watcher.packets_planned, watcher.packets_sent
            progress.update(air, total=round(planned * airtime_s) or None, completed=round(sent * airtime_s))
            progress.update(shore, total=len(watcher.encoded) or None, completed=len(watcher.shore))
            busy = watcher.busy(files, time.time() - 5.0)
            if watcher.changes != changes:
                changes, changed_at, quiet_since = watcher.changes, now, None
            if busy:
                quiet_since = None
                if now - changed_at > STALLED_S + 10 * airtime_s / chain.settings.time_scale:
                    console.print(f"[red]nothing has moved for a minute; still busy: {busy}")
                    return
            elif quiet_since is None:
                quiet_since = now
            elif now - quiet_since > QUIET_S + watcher.settled_s:
                return
            time.sleep(0.1)
