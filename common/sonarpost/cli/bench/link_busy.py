"""`sonarpost bench busy`: how much of the time a vehicle that has data keeps the water busy, simulated."""

from __future__ import annotations

import argparse

from sonarpost.simulation.mission.utilisation import BusySpec, run_busy


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    usual = BusySpec()
    parser = actions.add_parser(
        "busy", help="share of the time that a vehicle with data keeps the water busy, simulated"
    )
    parser.add_argument("--rate", type=int, default=usual.rate, help="0 to 6 (%(default)s)")
    parser.add_argument("--baud", type=float, default=usual.serial_baud, help="serial lines; 0 no delay (%(default)s)")
    parser.add_argument("--listen", type=float, default=usual.rx_window_s, metavar="S", help="each pause (%(default)s)")
    parser.add_argument("--every", type=float, default=usual.tx_burst_s, metavar="S", help="between (%(default)s)")
    parser.add_argument("--range", type=float, default=usual.range_m, metavar="M", help="in metres (%(default)s)")
    parser.add_argument("--loss", type=float, default=usual.frame_loss, help="share of frames lost (%(default)s)")
    parser.add_argument("--seconds", type=float, default=usual.seconds, help="for how long (%(default)s)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    spec = BusySpec(args.rate, args.baud, args.every, args.listen, args.range, args.loss, args.seconds)
    result = run_busy(spec)
    print(
        f"busy {result.busy:.4f}: {result.packets} packets, {result.frames_full:.3f} of their frames filled; "
        f"{result.reports} of {result.reports_sent} reports heard"
    )
    return 0
