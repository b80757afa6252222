"""Free TCP ports for the services of a research command."""

import socket
from contextlib import suppress
from random import SystemRandom

FREE_PORTS = (10_000, 32_000)
"""Range of `free_ports`: below the ports of outgoing connections, which could take one while no router listens."""


def free_ports(count: int) -> tuple[int, ...]:
    """Return different random TCP ports of `FREE_PORTS` that are free now."""
    # Seeded by the system: another process with the same seed would take the same ports.
    random, found = SystemRandom(), set[int]()
    while len(found) < count:
        port = random.randrange(*FREE_PORTS)
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            found.add(port)
    return tuple(found)
