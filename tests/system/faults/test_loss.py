"""A slow link with 20 % packet loss in the kernel: real TCP retransmissions.

The processes of the shore run in a separate network namespace, connected by a pair of interfaces. A token bucket filter
limits both directions, and nftables drops random packets inside the namespace. Kernels without netem have both.
"""

import os
import re
import shutil
import subprocess
from contextlib import ExitStack

import pytest
from builders.image_source import make_image

COUNT = 100
RATE_BITS_PER_S = 8 * 160_000
LOSS_PERCENT = 20
VESSEL_ADDRESS, SHORE_ADDRESS = "198.18.77.1", "198.18.77.2"  # RFC 2544: reserved for measurements


def run(*command):
    """Run a command; skip the test with the reason if it fails."""
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"{' '.join(command)}: {(done.stderr or done.stdout).strip()}")


@pytest.fixture
def lossy_shore():
    """Name of a network namespace behind a slow and lossy link."""
    for program in ("ip", "tc", "nft"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    if os.geteuid() != 0:
        pytest.skip("network namespaces require root")
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


def test_delivery_at_20_percent_packet_loss_and_160_kb_per_s(lossy_shore, start_system):
    system = start_system(shore_prefix=("ip", "netns", "exec", lossy_shore), shore_host=SHORE_ADDRESS)
    system.send([make_image(n, (120, 160) if n % 2 else (24, 32)) for n in range(COUNT)])
    system.assert_all_delivered_once()
    command = ["ip", "netns", "exec", lossy_shore, "nft", "list", "table", "ip", "loss"]
    counters = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    dropped = [int(count) for count in re.findall(r"packets (\d+)", counters)]
    assert len(dropped) == 2
    assert min(dropped) > 0, "packets were dropped in both directions"
