"""The `sonarpost demo` command."""

from __future__ import annotations

import argparse
import importlib
import json
import logging
import re
import shutil
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import progress_console
from sonarpost.cli.shared import add_fit_option, add_survey_options, flag, option, print_notes, survey_options_of
from sonarpost.errors import ConfigError, SurveyFileError
from sonarpost.extensions.simulation.demo.chain import Chain
from sonarpost.extensions.simulation.demo.next_steps import commands, folder_lines, routers_line
from sonarpost.extensions.simulation.demo.operator_page import OperatorPage
from sonarpost.extensions.simulation.demo.outcome import evaluate
from sonarpost.extensions.simulation.demo.own_images import usable_images
from sonarpost.extensions.simulation.demo.report import show
from sonarpost.extensions.simulation.demo.settings import CONSOLE_PORT, ROUTER_PORTS, ChainSettings, reserved_ports
from sonarpost.extensions.simulation.demo.watch import Watcher
from sonarpost.extensions.simulation.modem.emulated import emulated_drivers
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.modem.registry import DEFAULT_DRIVER, modem_driver
from sonarpost.sonar.image_files import SIDE_CAR_SUFFIX
from sonarpost.sonar.readers import open_survey, recording_parts, supported_suffixes
from sonarpost.sonar.survey import Survey
from sonarpost.sonar.xtf_writer import write_xtf

MARKER = ".sonarpost-demo"
QUIET_S = 1.5
"""Real time without a change after which an idle chain has finished."""
STALLED_S = 300.0
"""Real time without a change after which the demo ends although the chain is busy."""
MAX_FEEDBACK_INTERVALS = 60
"""Feedback intervals without a change, on top of `STALLED_S`, while the vessel still repeats feedback."""


def add_options(parser: CommandParser) -> None:
    """Add the subcommand."""
    parser.description = (
        "Run every service as a process, with emulated acoustic modems on pseudo-terminals, three Zenoh "
        "routers, and a simulated or given survey. Ends with a table and a contact sheet. The exit status is 1 if an "
        "image that the channel can deliver is missing or incomplete at the shore site, or if there is no contact."
    )
    source = parser.add_mutually_exclusive_group()
    option(source, "--survey FILE_OR_DIR", "survey file, or a folder of them", Path)
    option(source, "--images DIR", "send your own images instead: a file or a folder", Path)
    add_fit_option(parser)
    option(parser, "--out DIR", "output", Path, Path("demo-out"))
    link = parser.add_mutually_exclusive_group()
    option(
        link,
        "--link",
        "wire format: v1 with the codec emb, or the paper's with its tile codec",
        default="v1",
        choices=("v1", "paper"),
    )
    option(link, "--paper", "short for --link paper", action="store_const", const="paper", dest="link")
    option(
        parser,
        "--rate",
        "rate of the modem (default: that of its driver; Micro-Modem: 1, packets of 192 B in 6.1 s, see "
        "docs/reference/modem-rates.md)",
        int,
    )
    option(parser, "--modem", "driver whose modems are emulated", default=DEFAULT_DRIVER, choices=emulated_drivers())
    option(parser, "--loss P", "probability that a frame is lost", _probability, 0.0)
    option(parser, "--seed N", "seed of the survey and channel simulators", int, 1)
    option(parser, "--time-scale X", "simulated seconds per second", _positive, 20.0)
    flag(parser, "--keep", "keep services and routers running until Ctrl-C")
    flag(parser, "--console", "like --keep, and serve the operator's page: a log-in link is shown")
    flag(parser, "--open", "with --console: open the page in the default browser")
    option(parser, "--threshold CONFIDENCE", "minimum confidence of a contact, 0 to 2 (default: 0.3)", float)
    add_survey_options(parser)
    flag(parser, "--json", "print one JSON object as the last line")
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


def _rate(parsed: argparse.Namespace) -> int:
    """Return the rate of the demo.

    Raises:
        ConfigError: The modem does not have it.
    """
    modem = modem_driver(parsed.modem).capabilities
    rate = modem.uplink_rate if parsed.rate is None else int(parsed.rate)
    if rate not in modem.rates:
        raise ConfigError("command line", "--rate", rate, f"one of {sorted(modem.rates)}")
    return rate


def run(parsed: argparse.Namespace) -> int:
    """Run the demo; return 0 if everything that the channel can deliver is at the shore site, unchanged."""
    console = progress_console()
    if parsed.console:
        importlib.import_module("uvicorn")  # a missing extra is reported before the services start
    # Routers and services start together: failed first attempts to connect are expected.
    logging.getLogger("sonarpost.bus.session").setLevel(logging.ERROR)
    started = time.monotonic()
    rate = _rate(parsed)
    detection_settings, inputs = _detection_settings(parsed), _inputs(parsed, console)
    if inputs is not None and inputs[0] == parsed.survey:
        # A single file that cannot be read is reported before the services start.
        with open_survey(parsed.survey, survey_options_of(parsed)) as source:
            print_notes(source.info)
    folder = _fresh_folder(parsed.out)
    simulated = _simulate(parsed.seed, console) if inputs is None else None
    with reserved_ports(*ROUTER_PORTS, *((CONSOLE_PORT,) if parsed.console else ())) as ports:
        settings = ChainSettings(
            folder=folder,
            mode="snippets" if parsed.images else "survey",
            link=parsed.link,
            modem=parsed.modem,
            rate=rate,
            loss=parsed.loss,
            seed=parsed.seed,
            time_scale=parsed.time_scale,
            router_ports=(ports[0], ports[1], ports[2]),
            console_port=ports[3] if parsed.console else None,
            extra=(*detection_settings, ("atd_stub", f'fit = "{parsed.fit}"')),
        )
        return _run_chain(parsed, settings, (inputs, simulated), started, console)


def _run_chain(
    parsed: argparse.Namespace,
    settings: ChainSettings,
    sources: tuple[tuple[Path, ...] | None, Survey | None],
    started_s: float,
    console: Console,
) -> int:
    """Run the chain with the given files or the simulated survey; return the exit status."""
    page = OperatorPage(settings) if parsed.console else None
    with Chain(settings) as chain, Watcher(settings, chain.check) as watcher:
        # During the start of the services: the vehicle processes files when it is ready.
        files = _deposit(*sources, settings, console)
        with console.status("starting three routers and eight services"):
            watcher.wait_until_started()
        console.print(routers_line(settings), highlight=False, soft_wrap=True)
        if page is not None:
            page.show(console, opened=parsed.open)
        _follow(chain, watcher, files, console)
        outcome = evaluate(settings, watcher.snippets, watcher.contact_of_image, time.monotonic() - started_s)
        results = Console(stderr=True)  # printed with --quiet as well
        refused = _print_refused(settings, results)
        keep = bool(watcher.snippets) and (parsed.keep or parsed.console)
        if watcher.snippets:
            show(watcher, settings, outcome, results)
            _print_next_steps(settings, console, running=keep)
        else:
            _print_no_contacts(settings, results)
        if parsed.json:
            print(outcome.as_json(), flush=True)
        if keep:
            if page is not None:
                page.show(console)
            _keep_running(chain)
    return 0 if watcher.snippets and outcome.succeeded and refused < files else 1


def _print_next_steps(settings: ChainSettings, console: Console, *, running: bool) -> None:
    """Print where the images are, and commands to paste."""
    state = "services and routers run until Ctrl-C" if running else "stopped; `--keep` leaves them running"
    for line in (*folder_lines(settings), f"{routers_line(settings)} ({state})"):
        console.print(line, highlight=False, soft_wrap=True)
    console.print("\nNext, in this folder" + (" in another terminal:" if running else ":"), highlight=False)
    for command, purpose in commands(settings, running=running):
        # Lines to paste: never wrapped.
        console.print(f"  {command}", style="bold", highlight=False, markup=False, soft_wrap=True)
        console.print(f"      {purpose}", highlight=False)


def _keep_running(chain: Chain) -> None:
    """Wait for Ctrl-C.

    Raises:
        ChainError: A process of the chain has ended.
    """
    try:
        while True:
            chain.check()
            time.sleep(0.5)
    except KeyboardInterrupt:
        return


def _inputs(parsed: argparse.Namespace, console: Console) -> tuple[Path, ...] | None:
    """Return the files to process, None for a simulated survey.

    Raises:
        SurveyFileError: There is no such file or folder, or no suitable file in it.
    """
    if parsed.images is not None:
        return usable_images(parsed.images, parsed.fit, console)
    given: Path | None = parsed.survey
    if given is None:
        return None
    suffixes = supported_suffixes()
    if given.is_file():
        if not given.name.lower().endswith(suffixes):
            raise SurveyFileError(str(given), "suffix", given.suffix, "one of " + ", ".join(suffixes))
        return (given,)
    if not given.is_dir():
        raise SurveyFileError(str(given), "", "no such file or folder", "a file or folder that exists")
    found = tuple(sorted(p for p in given.iterdir() if p.name.lower().endswith(suffixes) and p.is_file()))
    if not found:
        raise SurveyFileError(str(given), "", "no such file in it", "files named *" + ", *".join(suffixes))
    return found


def _detection_settings(parsed: argparse.Namespace) -> tuple[tuple[str, str], ...]:
    """Return --threshold and the survey options as lines of [atd_stub].

    Raises:
        ConfigError: They are invalid, or given with --images.
    """
    survey_options_of(parsed)
    if parsed.threshold is not None and not 0 <= parsed.threshold <= 2:
        raise ConfigError("demo", "--threshold", parsed.threshold, "0 to 2")
    given = {
        "survey_options": parsed.options and str(parsed.options.absolute()),
        "projected_crs": parsed.crs,
        "confidence_threshold": parsed.threshold,
    }
    lines = [(key, json.dumps(value, ensure_ascii=False)) for key, value in given.items() if value is not None]
    if lines and parsed.images:
        raise ConfigError("demo", "--images", str(parsed.images), "--survey with --options, --crs or --threshold")
    return tuple(("atd_stub", f"{key} = {text}") for key, text in lines)


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


def _print_no_contacts(settings: ChainSettings, console: Console) -> None:
    """Print how many contacts each file has at lower thresholds, as atd_stub has logged it, and what can be done."""
    log = (settings.folder / "logs" / "atd_stub.log").read_text(encoding="utf-8", errors="replace")
    files = re.findall(r' File processed .*?file=("[^"]*"|\S+) .*counts="([^"]*)"', log)
    for name, counts in files:
        console.print(f"{name}: {counts}", markup=False, highlight=False, soft_wrap=True)
    lower = any(int(count) for _, counts in files for count in re.findall(r"(\d+) (?:contacts )?above", counts))
    console.print(
        "[red]no contacts to send[/red]: "
        + ("run the demo again with a lower --threshold, or " if lower else "")
        + "cut out places of your choice with `sonarpost detect --pick PING,SIDE,SAMPLE --snippets DIR`, "
        "and send these images with `sonarpost demo --images DIR`",
        highlight=False,
        soft_wrap=True,
    )


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
    side_cars = 0
    for path in inputs:
        side_car = path.with_suffix(SIDE_CAR_SUFFIX)
        if settings.mode == "snippets" and side_car.is_file():
            shutil.copyfile(side_car, settings.incoming / side_car.name)
            side_cars += 1
        if settings.mode != "snippets":
            _copy_other_parts(path, settings.incoming)
        partial = settings.incoming / f".{path.name}"
        shutil.copyfile(path, partial)
        partial.rename(settings.incoming / path.name)
    if settings.mode == "snippets":
        console.print(f"{side_cars} of {len(inputs)} images have a side-car with their position")
    console.print(f"{len(inputs)} input file{'s' if len(inputs) != 1 else ''}")
    return len(inputs)


def _copy_other_parts(path: Path, folder: Path) -> None:
    """Copy the other files of a recording that exist beside it or below its folder."""
    for part in recording_parts(path):
        if part != path and part.is_relative_to(path.parent) and part.is_file():
            target = folder / part.relative_to(path.parent)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(part, target)


def _follow(chain: Chain, watcher: Watcher, files: int, console: Console) -> None:
    """Show progress until the chain has finished, or nothing has changed for too long."""
    settings = chain.settings
    airtime_s = settings.rate_info.airtime_s
    stalled_s = STALLED_S + 10 * settings.packet_s + MAX_FEEDBACK_INTERVALS * settings.feedback_interval_s
    columns = (
        TextColumn("{task.description:<24}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[unit]}"),
    )
    with Progress(*columns, TimeElapsedColumn(), console=console) as progress:
        air = progress.add_task("acoustic air time", total=None, unit="s")
        shore = progress.add_task("images at the shore site", total=None, unit="")
        changes, changed_at, idle_since_utc_s = -1, time.monotonic(), 0.0
        while True:
            chain.check()
            now = time.monotonic()
            planned, sent = watcher.packets_planned, watcher.packets_sent
            progress.update(air, total=round(planned * airtime_s) or None, completed=round(sent * airtime_s))
            progress.update(shore, total=len(watcher.encoded) or None, completed=watcher.images_at_shore)
            busy = watcher.busy(files, time.time() - 5.0)
            if watcher.changes != changes:
                changes, changed_at, idle_since_utc_s = watcher.changes, now, 0.0
            if busy:
                idle_since_utc_s = 0.0
                if now - changed_at > stalled_s:
                    console.print(f"[red]no change for {stalled_s:.0f} s; still busy: {busy}")
                    return
            elif not idle_since_utc_s:
                idle_since_utc_s = time.time()
            quiet = idle_since_utc_s and time.time() - idle_since_utc_s > QUIET_S + settings.packet_s
            # A report may be older than the last work of its service: decide by newer ones.
            if quiet and not watcher.busy(files, idle_since_utc_s):
                return
            time.sleep(0.1)
