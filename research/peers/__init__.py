"""Durable store-and-forward software of others, started by the benchmarks that compare the relay with it.

Each module starts two servers of one system: a sender, where the records wait on disk, and a receiver, which stores
them. Both write a record to disk before they acknowledge it, as the relay and c2 do.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path

from research.peers import nats, rabbitmq, redis
from research.peers.base import AbsentError, Drained, Peer

__all__ = ["PEERS", "AbsentError", "Drained", "Peer"]

PEERS: dict[str, Callable[[Path, int, int], AbstractContextManager[Peer]]] = {
    "nats": nats.start,
    "rabbitmq": rabbitmq.start,
    "redis": redis.start,
}
"""By name: the function that starts the servers. Its arguments: an empty or absent folder of their own for records and
logs; the port on which the receiver listens; the port to which the sender connects (the same, or that of a link to it).
It raises `AbsentError` if a program or package is not installed, `StartError` if a server does not start."""
