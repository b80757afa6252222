"""A thin link that loses every fifth packet, in the kernel: real TCP, real retransmissions.

The shore's processes run in a network namespace of their own, joined by a pair of interfaces. Both directions are
limited by a token bucket filter, and packets are dropped at random by nftables inside the namespace (kernels without
the netem scheduler have both).
"""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from builders.coast import Coast
from builders.feeder import make_image

COUNT = 200
RATE_BITS_PER_S = 8 * 160_000
LOSS_PERCENT = 20
VESSEL_ADDRESS, SHORE_ADDRESS = "198.18.77.1", "198.18.77.2"  # RFC 2544: for measurements, routed nowhere


def run(*command: str) -> None:
    """Run a command, or skip the test, saying what failed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"{' '.join(command)}: {(done.stderr or done.stdout).strip()}")


@pytest.fixture
def lossy_shore() -> Iterator[str]:
    """A network namespace behind a thin and lossy link; the fixture is its name."""
    for program in ("ip", "tc", "nft"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    if os.geteuid() != 0:
        pytest.skip("network namespaces can be made by root only")
    name = f"sonarpost{os.getpid()}"
    near, far = f"sn{os.getpid()}", f"sf{os.getpid()}"
    inside = ("ip", "netns", "exec", name)
    with ExitStack() as stack:
        run("ip", "netns", "add", name)
        stack.callback(subprocess.run, ["ip", "netns", "del", name], check=True)
        run("ip", "link", "add", near, "type", "veth", "peer", "name", far, "netns", name)
        run("ip", "addr", "add", f"{VESSEL_ADDRESS}/30", "dev", near)
        run("ip", "link", "set", near, "up")
        run(*inside, "ip", "addr", "add", f"{SHORE_ADDRESS}/30", "dev", far)
        for device in (far, "lo"):
            run(*inside, "ip", "link", "set", device, "up")
        limit = ("root", "tbf", "rate", f"{RATE_BITS_PER_S}bit", "burst", "16kb", "latency", "300ms")
        run("tc", "qdisc", "add", "dev", near, *limit)
        run(*inside, "tc", "qdisc", "add", "dev", far, *limit)
        run(*inside, "nft", "add", "table", "ip", "loss")
        for chain, hook, match in (("from", "input", "iifname"), ("to", "output", "oifname")):
            run(*inside, "nft", f"add chain ip loss {chain} {{ type filter hook {hook} priority 0; }}")
            dropped = f"numgen random mod 100 < {LOSS_PERCENT} counter drop"
            run(*inside, "nft", f"add rule ip loss {chain} {match} {far} {dropped}")
        yield name


@pytest.mark.long
@pytest.mark.timeout(600)
def test_every_fifth_packet_lost_on_a_link_of_160_kilobytes_a_second(
    lossy_shore: str, start_coast: Callable[..., Coast]
) -> None:
    coast = start_coast(shore_prefix=("ip", "netns", "exec", lossy_shore), shore_host=SHORE_ADDRESS)
    coast.owe([make_image(n, (120, 160) if n % 2 else (24, 32)) for n in range(COUNT)])
    coast.assert_all_ashore_once(500)
    counters = subprocess.run(
        ["ip", "netns", "exec", lossy_shore, "nft", "list", "table", "ip", "loss"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    dropped = [
        int(words[words.index("packets") + 1])
        for line in counters.splitlines()
        if (words := line.split()) and "packets" in words
    ]
    assert len(dropped) == 2
    assert min(dropped) > 20, "packets were dropped in both directions"
