"""`sonarpost bench mission`: a day of several vehicles in one water, what arrived and how long it took."""

from __future__ import annotations

import argparse
import statistics

from sonarpost.simulation.mission.mission import Account, MissionSpec, run_mission


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    usual = MissionSpec()
    parser = actions.add_parser("mission", help="a day of several vehicles' traffic through one water, simulated")
    parser.add_argument("--vehicles", type=int, default=usual.vehicles, help="1 to 16 (%(default)s)")
    parser.add_argument("--hours", type=float, default=usual.hours, help="how long (%(default)s)")
    parser.add_argument("--loss", type=float, default=usual.loss, help="share of frames lost (%(default)s)")
    parser.add_argument("--burst", type=float, default=usual.burst_frames, help="mean run of lost frames (%(default)s)")
    parser.add_argument("--seed", type=int, default=usual.seed, help="of everything drawn (%(default)s)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Run a mission and print what became of it."""
    spec = MissionSpec(args.vehicles, args.hours, args.loss, args.burst, seed=args.seed)
    result = run_mission(spec)
    print(f"{'':12} {'offered':>8} {'arrived':>8} {'median s':>9} {'longest s':>10}")
    for name, account in (*result.messages.items(), ("previews", result.previews), ("pictures", result.pictures)):
        print(_line(name, account))
    print(f"{result.frames_sent} frames sent, {result.restarts} restarts, {result.expired} messages expired")
    print(f"{result.left} left; state {max(result.state_bytes) / 1000:.0f} kB at most")
    return 0


def _line(name: str, account: Account) -> str:
    delays_s = account.delays_s or [0.0]
    times = f"{statistics.median(delays_s):9.0f} {max(delays_s):10.0f}"
    return f"{name:12} {account.offered:8} {account.delivered:8.4f} {times}"
