"""Software of others that the benchmarks start: it stores at the receiver what waits at the sender."""

import re
import shutil
import sys
import time
from contextlib import closing, contextmanager

import pytest
from builders.common import eventually, free_port

from research.common.link_emulator import LinkEmulator
from research.peers import PEERS, AbsentError, Peer
from research.peers.base import StartError, program, server

COUNT = 600


@contextmanager
def linked(name, folder):
    """A link, and both servers of a peer, whose sender uses it."""
    port = free_port()
    with closing(LinkEmulator(port)) as link:
        try:
            with PEERS[name](folder / name, port, link.port) as peer:
                yield link, peer
        except AbsentError as error:
            pytest.skip(str(error))


def records(count):
    return [b"%0200d" % number for number in range(count)]


@pytest.mark.parametrize("name", PEERS)
def test_the_receiver_stores_every_record_once(name, tmp_path):
    with linked(name, tmp_path) as (link, peer):
        for count in (COUNT, COUNT + 1):
            peer.fill(records(count))
            drained = peer.drain(count)
            assert drained.records == count
            assert min(drained.seconds, drained.per_s) > 0
        assert peer.stored() == COUNT + 1
        assert link.attempts > 0


def test_the_forwarder_of_redis_connects_again(tmp_path):
    with linked("redis", tmp_path) as (link, peer):
        peer.fill(records(COUNT))
        link.cut()
        peer.connect()
        eventually(lambda: link.attempts > 1)
        assert peer.stored() == 0
        link.mend()
        eventually(lambda: peer.stored() == COUNT)


class Counted(Peer):
    """A receiver with these numbers of records, one after the other; the last stays."""

    def __init__(self, *counts):
        self.counts = list(counts)

    def fill(self, payloads):
        raise NotImplementedError

    def connect(self):
        self.connected_s = time.perf_counter()

    def stored(self):
        return self.counts.pop(0) if len(self.counts) > 1 else self.counts[0]


def test_a_drain_counts_from_the_first_arrival():
    drained = Counted(0, 0, 40, 100).drain(100)
    assert drained.records == 100
    # 60 records after the first arrival, in a part of the time.
    assert drained.per_s > 60 / drained.seconds


def test_a_drain_ends_after_its_time_with_what_has_arrived():
    drained = Counted(0, 7).drain(8, timeout_s=0.1)
    assert drained.records == 7
    assert drained.seconds >= 0.1
    assert drained.per_s == 7 / drained.seconds


def test_an_absent_program_is_named_with_its_package(tmp_path):
    with pytest.raises(AbsentError, match=re.escape("no-such-server is not installed (pip install it)")):
        program("no-such-server", "pip install it", str(tmp_path))
    assert program("sh", "never") == shutil.which("sh")


def test_a_server_that_ends_is_reported_with_its_log(tmp_path):
    command = [sys.executable, "-c", "raise SystemExit('bad option')"]
    with pytest.raises(StartError, match="bad option"), server(command, free_port(), tmp_path / "log"):
        raise AssertionError("it runs")
