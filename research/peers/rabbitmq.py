"""RabbitMQ: a durable classic queue in each of two servers, and a shovel of the sender.

The shovel acknowledges a record to the sender's queue after the receiver has confirmed it, with at most 1000
unconfirmed records. A server confirms a persistent record when it is on disk.
"""

from __future__ import annotations

import base64
import importlib
import json
import os
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

from typing_extensions import override

from research.common.ports import free_ports
from research.peers.base import START_TIMEOUT_S, AbsentError, Peer, StartError, program, server

if TYPE_CHECKING:
    import pika

PREFETCH = 1000
QUEUE = "records"
CONFIG = """\
listeners.tcp.1 = 127.0.0.1:{port}
management.tcp.ip = 127.0.0.1
management.tcp.port = {management_port}
management_agent.disable_metrics_collector = true
disk_free_limit.absolute = 100MB
"""


class RabbitMq(Peer):
    """Queues with a shovel."""

    def __init__(
        self, client: ModuleType, sender_port: int, receiver_port: int, link_port: int, management_port: int
    ) -> None:
        self._pika = client
        self._uris = {"src": f"amqp://127.0.0.1:{sender_port}", "dest": f"amqp://127.0.0.1:{link_port}"}
        self._shovel = f"http://127.0.0.1:{management_port}/api/parameters/shovel/%2f/link"
        self._sender_port = sender_port
        self._connection = self._open(receiver_port)
        self._receiver = self._connection.channel()
        self._receiver.queue_declare(QUEUE, durable=True)
        self._is_connected = False

    def _open(self, port: int) -> pika.BlockingConnection:
        return self._pika.BlockingConnection(self._pika.ConnectionParameters("127.0.0.1", port, heartbeat=0))

    @override
    def fill(self, payloads: Sequence[bytes]) -> None:
        """Remove the shovel and empty both queues, then add the records to the sender's in one transaction."""
        if self._is_connected:
            self._manage("DELETE", None)
            self._is_connected = False
        self._receiver.queue_purge(QUEUE)
        connection = self._open(self._sender_port)
        channel = connection.channel()
        channel.queue_declare(QUEUE, durable=True)
        channel.queue_purge(QUEUE)
        persistent = self._pika.BasicProperties(delivery_mode=2)
        channel.tx_select()
        for payload in payloads:
            channel.basic_publish("", QUEUE, payload, persistent)
        channel.tx_commit()
        connection.close()

    @override
    def connect(self) -> None:
        """Create the shovel."""
        queues = {f"{side}-queue": QUEUE for side in self._uris}
        uris = {f"{side}-uri": uri for side, uri in self._uris.items()}
        options = {"ack-mode": "on-confirm", "src-prefetch-count": PREFETCH, "reconnect-delay": 1}
        self._manage("PUT", {"value": {**uris, **queues, **options}})
        self._is_connected = True

    def _manage(self, method: str, content: object) -> None:
        """Send a request about the shovel; wait while the server still starts its interface.

        Raises:
            StartError: The interface does not answer within two minutes.
        """
        credentials = base64.b64encode(b"guest:guest").decode()
        headers = {"Authorization": f"Basic {credentials}", "Content-Type": "application/json"}
        request = urllib.request.Request(self._shovel, json.dumps(content).encode(), headers, method=method)
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while True:
            try:
                urllib.request.urlopen(request, timeout=START_TIMEOUT_S).close()
            except urllib.error.URLError as error:
                if time.monotonic() > deadline_s:
                    raise StartError(f"{method} {self._shovel}: {error}") from None
                time.sleep(0.1)
            else:
                return

    @override
    def stored(self) -> int:
        """Return the length of the receiver's queue."""
        return int(self._receiver.queue_declare(QUEUE, passive=True).method.message_count)

    def close(self) -> None:
        """End the connection."""
        self._connection.close()


@contextmanager
def start(folder: Path, receiver_port: int, link_port: int) -> Iterator[RabbitMq]:
    """Start both servers; arguments and errors: `PEERS`."""
    # Debian's program of this name in PATH changes the user and the folders.
    executable = program("rabbitmq-server", "apt-get install rabbitmq-server", "/usr/lib/rabbitmq/bin")
    try:
        client = importlib.import_module("pika")
    except ImportError:
        raise AbsentError("pika is not installed (pip install pika)") from None
    sender_port, names_port, *other_ports = free_ports(6)
    with ExitStack() as stack:
        folder.mkdir(parents=True, exist_ok=True)
        # The name server of Erlang; a node would start one that outlives it.
        environment = {**os.environ, "ERL_EPMD_ADDRESS": "127.0.0.1", "ERL_EPMD_PORT": str(names_port)}
        names = program("epmd", "apt-get install rabbitmq-server")
        stack.enter_context(server([names], names_port, folder / "epmd.log", environment))
        management = {}
        for name, port in (("sender", sender_port), ("receiver", receiver_port)):
            (data := folder / name).mkdir()
            management[name], distribution_port = other_ports.pop(), other_ports.pop()
            (data / "rabbitmq.conf").write_text(CONFIG.format(port=port, management_port=management[name]))
            (data / "enabled_plugins").write_text("[rabbitmq_management,rabbitmq_shovel].\n")
            settings = {
                "HOME": str(data),
                "RABBITMQ_CONFIG_FILE": str(data / "rabbitmq.conf"),
                "RABBITMQ_ENABLED_PLUGINS_FILE": str(data / "enabled_plugins"),
                "RABBITMQ_CONF_ENV_FILE": str(data / "absent"),
                "RABBITMQ_NODENAME": f"{name}@localhost",
                "RABBITMQ_DIST_PORT": str(distribution_port),
                "RABBITMQ_MNESIA_BASE": str(data / "data"),
                "RABBITMQ_LOG_BASE": str(data / "log"),
            }
            stack.enter_context(server([executable], port, folder / f"{name}.log", {**environment, **settings}))
        peer = RabbitMq(client, sender_port, receiver_port, link_port, management["sender"])
        stack.callback(peer.close)
        yield peer
