"""The `sonarpost demo` command."""

import argparse
import importlib
import importlib.util
import json
import logging
import re
import secrets
import shlex
import shutil
import sys
import time
import webbrowser
from contextlib import closing
from pathlib import Path

from rich.console import Console

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay, progress_console
from sonarpost.cli.shared import add_fit_option, add_survey_options, flag, option, print_notes, survey_options_of
from sonarpost.codec.fitting import Fit, fit_image
from sonarpost.errors import BadInputError, ConfigError, SurveyFileError
from sonarpost.extensions.simulation.demo.chain import Chain
from sonarpost.extensions.simulation.demo.outcome import evaluate
from sonarpost.extensions.simulation.demo.report import show, shown
from sonarpost.extensions.simulation.demo.settings import (
    CONSOLE_PORT,
    ROUTER_PORTS,
    VESSEL,
    ChainSettings,
    reserved_ports,
)
from sonarpost.extensions.simulation.demo.watch import Watcher
from sonarpost.extensions.simulation.modem.emulated import emulated_drivers
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf
from sonarpost.modem.registry import DEFAULT_DRIVER, modem_driver
from sonarpost.services.console.store.users import FILE_NAME, LINK_S, Users, login_link
from sonarpost.sonar.image_decoding import read_any_image
from sonarpost.sonar.image_files import SIDE_CAR_SUFFIX, list_images
from sonarpost.sonar.readers import open_survey, recording_parts, supported_suffixes
from sonarpost.sonar.side_car import read_side_car
from sonarpost.sonar.survey import Survey

MARKER = ".sonarpost-demo"
QUIET_S = 1.5
"""Real time without a change after which an idle chain has finished."""
STALLED_S = 300.0
"""Real time without a change after which the demo ends although the chain is busy."""
MAX_FEEDBACK_INTERVALS = 60
"""Feedback intervals without a change, on top of `STALLED_S`, while the vessel still repeats feedback."""
SUBSCRIBER = Path("examples/shore_subscriber.py")
USER = "op"


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
    if not 0 <= (value := float(text)) <= 1:
        raise argparse.ArgumentTypeError(f"{text}: expected 0 to 1")
    return value


def _positive(text: str) -> float:
    if not 0.1 <= (value := float(text)) <= 1000:
        raise argparse.ArgumentTypeError(f"{text}: expected 0.1 to 1000")
    return value


def run(parsed: argparse.Namespace) -> int:
    """Run the demo; return 0 if everything that the channel can deliver is at the shore site, unchanged."""
    console = progress_console()
    if parsed.console:
        importlib.import_module("uvicorn")  # a missing extra is reported before the services start
    # Routers and services start together: failed first attempts to connect are expected.
    logging.getLogger("sonarpost.bus.session").setLevel(logging.ERROR)
    started_s = time.monotonic()
    modem = modem_driver(parsed.modem).capabilities
    rate = modem.uplink_rate if parsed.rate is None else int(parsed.rate)
    if rate not in modem.rates:
        raise ConfigError("command line", "--rate", rate, f"one of {sorted(modem.rates)}")
    detection_settings = _detection_settings(parsed)
    files: tuple[Path, ...] = ()
    if parsed.images is not None:
        files = _usable_images(parsed.images, parsed.fit, console)
    elif parsed.survey is not None:
        files = _survey_files(parsed.survey)
        if files == (parsed.survey,):
            # A single file that cannot be read is reported before the services start.
            with open_survey(parsed.survey, survey_options_of(parsed)) as source:
                print_notes(source.info)
    folder = _fresh_folder(parsed.out)
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
        source_of = files or _simulated_survey(parsed.seed, console)
        return _run_chain(parsed, settings, source_of, started_s, console)


def _simulated_survey(seed: int, console: Console) -> Survey:
    """Return a simulated survey; print what it holds."""
    with console.status("simulating a survey of 1000 pings"):
        simulated = simulate_survey(SurveySpec(seed=seed, seabed=SeabedKind.SAND, targets=6, clutter=6))
    mines = sum(truth.is_mine_like for truth in simulated.truth)
    console.print(
        f"simulated survey of {len(simulated.survey.pings)} pings over sand: "
        f"{mines} mine-like objects, {len(simulated.truth) - mines} others"
    )
    return simulated.survey


def _survey_files(given: Path) -> tuple[Path, ...]:
    """Return a survey file, or those of a folder.

    Raises:
        SurveyFileError: There is no such file or folder, or no suitable file in it.
    """
    suffixes = supported_suffixes()
    if not given.exists():
        raise SurveyFileError(str(given), "", "no such file or folder", "a file or folder that exists")
    if not given.is_dir():
        if not given.name.lower().endswith(suffixes):
            raise SurveyFileError(str(given), "suffix", given.suffix, "one of " + ", ".join(suffixes))
        return (given,)
    found = tuple(sorted(p for p in given.iterdir() if p.name.lower().endswith(suffixes) and p.is_file()))
    if not found:
        raise SurveyFileError(str(given), "", "no such file in it", "files named *" + ", *".join(suffixes))
    return found


def _usable_images(source: Path, fit: Fit, console: Console) -> tuple[Path, ...]:
    """Return the images that the vehicle can send; print conversions and unused files.

    Args:
        source: An image or a folder of images, each with a side-car or without.
        fit: What the vehicle does with an image outside 16..512 px a side.
        console: Output.

    Raises:
        BadInputError: There is no such file or folder, or no image that can be sent.
    """
    if not source.exists():
        raise SurveyFileError(str(source), "", "no such file or folder", "an image or a folder of images")
    found = list_images(source) if source.is_dir() else None
    lines = list(found.unused) if found else []
    usable: list[Path] = []
    errors: list[BadInputError] = []
    for path in found.images if found else (source,):
        try:
            image = read_any_image(path)
            notes = image.notes + fit_image(image.pixels, fit, str(path)).notes
            side_car = path.with_suffix(SIDE_CAR_SUFFIX)
            if side_car.is_file():
                notes += read_side_car(side_car, "check", "uuv-1").notes
            lines += [f"{path}: {note}" for note in notes]
            usable.append(path)
        except BadInputError as error:
            errors.append(error)
            lines.append(f"not used: {error}")
    if errors and not usable:
        raise errors[0]
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    return tuple(usable)


def _deposit(paths: tuple[Path, ...], settings: ChainSettings, console: Console) -> None:
    """Copy files, with their side-cars or other parts, into the folder that the vehicle polls."""
    side_cars = 0
    for path in paths:
        others = [path.with_suffix(SIDE_CAR_SUFFIX)]
        if settings.mode == "survey":
            others = [part for part in recording_parts(path) if part != path and part.is_relative_to(path.parent)]
        present = [other for other in others if other.is_file()]
        side_cars += len(present)
        for other in present:
            target = settings.incoming / other.relative_to(path.parent)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(other, target)
        partial = settings.incoming / f".{path.name}"
        shutil.copyfile(path, partial)
        partial.rename(settings.incoming / path.name)
    if settings.mode == "snippets":
        console.print(f"{side_cars} of {len(paths)} images have a side-car with their position")
    console.print(f"{len(paths)} input file{'s' if len(paths) != 1 else ''}")


def _run_chain(
    parsed: argparse.Namespace,
    settings: ChainSettings,
    inputs: tuple[Path, ...] | Survey,
    started_s: float,
    console: Console,
) -> int:
    """Run the chain with the given files or the simulated survey; return the exit status."""
    password = secrets.token_urlsafe(9)
    if parsed.console:
        with _users(settings) as users:
            users.add(USER, "operator", password)
    with Chain(settings) as chain, Watcher(settings, chain.check) as watcher:
        # During the start of the services: the vehicle processes files when it is ready.
        if isinstance(inputs, Survey):
            write_xtf(inputs, settings.incoming / f"simulated-{settings.seed}.xtf")
        else:
            _deposit(inputs, settings, console)
        count = 1 if isinstance(inputs, Survey) else len(inputs)
        with console.status("starting three routers and eight services"):
            watcher.wait_until_started()
        console.print(settings.routers_line, highlight=False, soft_wrap=True)
        if parsed.console:
            _print_page(settings, password, console, opened=parsed.open)
        _follow(chain, watcher, count, console)
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
            if parsed.console:
                _print_page(settings, password, console)
            _keep_running(chain)
    return 0 if watcher.snippets and outcome.succeeded and refused < count else 1


def _users(settings: ChainSettings) -> closing[Users]:
    return closing(Users(settings.folder / "state" / VESSEL / FILE_NAME))


def _print_page(settings: ChainSettings, password: str, console: Console, *, opened: bool = False) -> None:
    """Print address, user, password and a log-in link of the operator's page; open another link if `opened`."""
    address = f"http://127.0.0.1:{settings.console_port}/"
    with _users(settings) as users:
        links = [login_link(address, users.make_login_link(USER)) for _ in range(2 if opened else 1)]
    for line in (
        f"operator's page: {address}  user: {USER}  password: {password}",
        f"log-in link, valid once, for {LINK_S / 60:.0f} minutes: {links[0]}",
    ):
        console.print(line, highlight=False, soft_wrap=True)
    if opened:
        webbrowser.open(links[1])


def _print_next_steps(settings: ChainSettings, console: Console, *, running: bool) -> None:
    """Print where the images are, and commands to paste into a terminal in the same folder."""
    images = settings.shore_images.parent
    sonarpost, endpoint = shown(Path(sys.executable).parent / "sonarpost"), f"tcp/127.0.0.1:{settings.router_ports[2]}"
    # `c2 ls` finds the folder of a demo in the current folder.
    is_default = images == Path("demo-out/shore/images").absolute()
    found = [
        (
            [sonarpost, "c2", "ls", *([] if is_default else ["--archive", shown(images)])],
            "list the contacts at the shore site",
        )
    ]
    if importlib.util.find_spec("uvicorn") is not None:  # the extra `console` is installed
        found.append(([sonarpost, "console", "--view", shown(images)], "show them in a browser; Ctrl-C ends it"))
    watch = [sonarpost, "c2", "watch", "--router", endpoint]
    if SUBSCRIBER.is_file():
        watch = [shown(Path(sys.executable)), str(SUBSCRIBER), endpoint, shown(settings.folder)]
    found.append((watch, "print contacts as they arrive" + ("" if running else ": start it, then another demo")))
    if running and settings.mode == "survey":
        survey = shown(settings.incoming / "next.xtf")
        found.append(([sonarpost, "simulate", survey, "--seed", str(settings.seed + 1)], "send another survey"))
    state = "services and routers run until Ctrl-C" if running else "stopped; `--keep` leaves them running"
    for line in (
        f"images at the vessel: {shown(settings.vessel_images)}",
        f"images at the shore site: {shown(settings.shore_images)}",
        f"{settings.routers_line} ({state})",
        "\nNext, in this folder" + (" in another terminal:" if running else ":"),
        # Lines to paste: never wrapped.
        *(f"  {shlex.join(words)}\n      {purpose}" for words, purpose in found),
    ):
        console.print(line, highlight=False, markup=False, soft_wrap=True)


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


def _follow(chain: Chain, watcher: Watcher, files: int, console: Console) -> None:
    """Show progress until the chain has finished, or nothing has changed for too long."""
    settings = chain.settings
    stalled_s = STALLED_S + 10 * settings.packet_s + MAX_FEEDBACK_INTERVALS * settings.feedback_interval_s
    changes, changed_at, idle_since_utc_s = -1, time.monotonic(), 0.0
    with ProgressDisplay(console) as display:
        while True:
            chain.check()
            now = time.monotonic()
            air = f"{watcher.packets_sent * settings.rate_info.airtime_s:.0f} s of air time"
            display.show("images at the shore site", len(watcher.shore), len(watcher.encoded) or None, air)
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
