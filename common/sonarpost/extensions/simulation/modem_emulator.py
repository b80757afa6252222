"""`sonarpost modem-emulator`: emulated Micro-Modems and the channel between them, without a configuration file."""

import argparse
import json
import os
import sys
import threading
from pathlib import Path

from pydantic import ValidationError

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import flag, in_new_folder, option
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.channel.config import EmulatorConfig
from sonarpost.extensions.simulation.channel.emulator import ChannelEmulator
from sonarpost.extensions.simulation.channel.parameters import PRESETS, build_parameters, config_error, read_parameters
from sonarpost.modem.registry import modem_driver
from sonarpost.stop_signals import stop_on_signals

WATCH_S = 0.2
EXIT_FAILED = 1
MAX_MODEMS = 64


def add_options(parser: CommandParser) -> None:
    """Add the subcommand."""
    parser.description = (
        "Emulates Micro-Modems and the channel between them until SIGINT or SIGTERM. The first line of the "
        'output is a JSON object, {"modems":[{"address":1,"device":"…"},…]}. Open the devices with any serial program '
        "or, for TCP, with a socket:// URL."
    )
    option(parser, "--modems N", "number of modems", int, 2)
    ports = parser.add_mutually_exclusive_group()
    option(ports, "--pty DIR", "links modem-1, … in DIR (default: modems)", Path, nargs="?", const=Path("modems"))
    option(ports, "--tcp PORT", "a TCP port for each modem; default: free ports", int, nargs="*")
    option(parser, "--mm", "Micro-Modem generation", int, 2, choices=(1, 2))
    option(parser, "--spacing M", "metres between modems", float, 100.0)
    option(parser, "--preset", "set of channel parameters (default: still)", choices=list(PRESETS))
    option(parser, "--channel FILE", "TOML file with parameters; overrides the preset", Path)
    for name, metavar, text in (
        ("loss", "P", "probability that a frame is lost (default: 0)"),
        ("packet-loss", "P", "probability that a packet is lost (default: 0)"),
        ("tail-damage", "P", "probability that the tail of a packet is damaged (default: 0)"),
        ("snr-at-1m", "DB", "signal-to-noise ratio at 1 m (default: 60)"),
        ("baud", "B", "speed of the serial lines, for example 19200 (default: 0, no delay)"),
    ):
        parser.add_argument(f"--{name}", type=float, metavar=metavar, help=text)
    for name, metavar, text in (
        ("set", "NAME=VALUE", "a channel parameter; overrides the file"),
        ("transponder", "LETTER=EAST,NORTH,DEPTH", "a ranging transponder, A to D; metres from modem 1"),
        ("airtime", "RATE=S", "air time of a rate in seconds, instead of the nominal one"),
    ):
        parser.add_argument(f"--{name}", action="append", default=[], metavar=metavar, help=text)
    flag(parser, "--range-loss", "lose frames also by signal-to-noise ratio")
    option(parser, "--seed N", "seed of every random draw (default: 0)", int)
    option(parser, "--time-scale X", "simulated seconds per second", float, 1.0)
    option(parser, "--log FILE", "append the result of every packet, as JSON lines", Path)
    flag(parser, "--json", "print the outcome of every packet, as JSON lines")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Run the emulator until SIGINT or SIGTERM; return 0, or 1 if it failed."""
    with stop_on_signals() as stop:
        return _serve(parsed, stop)


def _serve(parsed: argparse.Namespace, stop: threading.Event) -> int:
    emulator = ChannelEmulator(_config(parsed), echo=sys.stdout if parsed.json else None)
    try:
        devices = emulator.devices()
        listed = [{"address": device.address, "device": device.device} for device in devices]
        _print(json.dumps({"modems": listed}))
        emulator.start()
        if not parsed.json:
            for device in devices:
                _print(f"modem {device.modem}: address {device.address}, {device.device}")
        while not stop.wait(WATCH_S):
            if emulator.failure is not None:
                print(f"sonarpost: the emulator failed: {emulator.failure}", file=sys.stderr)
                return EXIT_FAILED
    finally:
        emulator.stop()
        _discard_unread()
    return 0


def _print(line: str) -> None:
    try:
        print(line, flush=True)
    except BrokenPipeError:
        # The emulator continues without a reader of its output.
        _discard_unread()


def _discard_unread() -> None:
    """Redirect output without a reader, for which Python would report an error at exit."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)


def _config(parsed: argparse.Namespace) -> EmulatorConfig:
    """Return the configuration that the command line describes.

    Raises:
        ConfigError: A value is out of range.
    """
    if not 1 <= parsed.modems <= MAX_MODEMS:
        raise ConfigError("command line", "--modems", parsed.modems, f"1..{MAX_MODEMS}")
    options = {
        "preset": parsed.preset,
        "seed": parsed.seed,
        "frame_loss": parsed.loss,
        "packet_loss": parsed.packet_loss,
        "tail_damage": parsed.tail_damage,
        "snr_at_1m_db": parsed.snr_at_1m,
        "range_loss": parsed.range_loss or None,
    }
    given = {name: value for name, value in options.items() if value is not None}
    from_file = read_parameters(parsed.channel) if parsed.channel else {}
    values = from_file | given | dict(_parameter(text) for text in parsed.set)
    build_parameters(values, "command line")
    try:
        return EmulatorConfig.model_validate(
            values
            | {
                "modem": [{"address": n + 1, "east_m": n * parsed.spacing} for n in range(parsed.modems)],
                "generation": parsed.mm,
                "airtime_s": dict(_airtime(text) for text in parsed.airtime),
                "pty_dir": parsed.pty or Path("modems"),
                "tcp_ports": (parsed.tcp or (0,) * parsed.modems) if parsed.tcp is not None else (),
                "time_scale": parsed.time_scale,
                "serial_baud": parsed.baud or 0.0,
                "log": None if parsed.log is None else in_new_folder(parsed.log),
                "transponder": [_transponder(text) for text in parsed.transponder],
            }
        )
    except ValidationError as error:
        raise config_error("command line", error) from error


def _parameter(text: str) -> tuple[str, float | bool | str]:
    name, _, value = text.partition("=")
    if value in {"true", "false"}:
        return name, value == "true"
    try:
        return name, int(value) if value.lstrip("-").isdigit() else float(value)
    except ValueError:
        return name, value


def _airtime(text: str) -> tuple[int, float]:
    rate, _, seconds = text.partition("=")
    try:
        return int(rate), float(seconds)
    except ValueError as error:
        rates = modem_driver().capabilities.rates
        expected = f"RATE=SECONDS with a rate {min(rates)}..{max(rates)}"
        raise ConfigError("command line", "--airtime", text, expected) from error


def _transponder(text: str) -> dict[str, str | float]:
    letter, _, place = text.partition("=")
    try:
        east_m, north_m, depth_m = (float(metres) for metres in [*place.split(","), "0", "0"][:3])
    except ValueError as error:
        raise ConfigError("command line", "--transponder", text, "LETTER=EAST[,NORTH[,DEPTH]] in metres") from error
    return {"letter": letter, "east_m": east_m, "north_m": north_m, "depth_m": depth_m}
