"""Attacks on the reception of short messages at c2; see `builders.hostile_rows`."""

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from itertools import count
from random import Random
from urllib.parse import urlencode

from builders.common import eventually, free_port
from builders.hostile_rows import Row, connections
from builders.hostile_site import HOSTILE, VESSEL, Site, request
from extensions.satellite.gateway import MessageGatewayEmulator
from extensions.satellite.records import decision, with_crc

from sonarpost.extensions.satellite.short_message import Item, ItemType, ShortMessage, pack_decision

NAME = "satellite"
IMEI = {VESSEL: "300234010753370", HOSTILE: "300234010753371"}
TOKEN = "0123456789abcdef"


@dataclass
class Webhook:
    """Port of the webhook, and the sequence numbers of the measured terminal."""

    port: int = field(default_factory=free_port)
    seqs: Iterator[int] = field(default_factory=count)


@contextmanager
def c2_table(site: Site) -> Iterator[str]:
    """Terminals of both vessels at a gateway; yield the keys of c2 for them."""
    webhook = site.added[NAME] = Webhook()
    (site.folder / "token").write_text(TOKEN)
    (site.folder / "password").write_text("password")
    terminals = ", ".join(f'{imei} = "{vessel}"' for vessel, imei in IMEI.items())
    with closing(MessageGatewayEmulator("http://127.0.0.1:9/", list(IMEI.values()))) as gateway:
        yield (
            f'[c2.short_messages]\nvessels = {{ {terminals} }}\ntoken_file = "{site.folder / "token"}"\n'
            f'port = {webhook.port}\ngateway = "{gateway.mt_url}"\nusername = "user"\n'
            f'password_file = "{site.folder / "password"}"\n'
        )


def message(epoch: int, seq: int, name: str) -> bytes:
    """Return a short message with one decision."""
    item = Item(ItemType.DECISION, pack_decision(decision(name)))
    return ShortMessage(epoch, seq, seq, (item,)).pack()


def messages_of_terminal(site: Site) -> list[float]:
    """Short messages of vessel-1's terminal, until the decision in each is stored and published."""
    sent_s = {}
    for number in site.numbers(5):
        sent_s[f"short-{number}"] = time.monotonic()
        assert deliver(site, VESSEL, message(7, next(site.added[NAME].seqs), f"short-{number}")) == 200
    return site.decisions.delays_s(sent_s)


def deliver(site: Site, vessel: str, data: bytes) -> int:
    """Deliver a short message as the gateway does, which repeats what fails; return the status, 200 or 400."""
    status = 0

    def delivered() -> bool:
        nonlocal status
        body = urlencode({"imei": IMEI[vessel], "momsn": "1", "data": data.hex()}).encode()
        status = request(f"http://127.0.0.1:{site.added[NAME].port}/{TOKEN}", body)
        return status in (200, 400)

    eventually(delivered, what="delivery of a short message")
    return status


@contextmanager
def slow_gateways(site: Site) -> Iterator[None]:
    """24 clients without the token that send a byte every 2 s."""
    with connections(site.added[NAME].port, 24, b"POST /guess HTTP/1.1\r\nX: ", 2.0):
        yield


@contextmanager
def slow_bodies(site: Site) -> Iterator[None]:
    """24 clients with the token, whose bodies arrive one byte every 2 s."""
    head = f"POST /{TOKEN} HTTP/1.1\r\nContent-Length: 4000\r\n\r\n".encode()
    with connections(site.added[NAME].port, 24, head, 2.0):
        yield


@contextmanager
def last_sequence_numbers(site: Site) -> Iterator[None]:
    """Messages with the last numbers of an epoch, and fragments that are never complete."""
    valid = ShortMessage(1, 0, 0, ()).pack()
    for number in (2**32 - 1, 2**32 - 2, 2**31, 300):
        # Type, epoch, sequence number, and how far the oldest is behind it.
        for behind in (0, 255):
            body = valid[:5] + number.to_bytes(4, "big") + bytes([behind])
            deliver(site, HOSTILE, with_crc(body))
    yield


@contextmanager
def junk_messages(site: Site) -> Iterator[None]:
    """Mutated messages of a terminal."""
    random, valid = Random(7), message(5, 0, "mutated")
    for _ in range(60):
        data = bytearray(valid)
        data[random.randrange(len(data))] ^= 1 << random.randrange(8)
        deliver(site, HOSTILE, bytes(data))
    yield


@contextmanager
def message_again(site: Site) -> Iterator[None]:
    """One message 100 times."""
    for _ in range(100):
        deliver(site, HOSTILE, message(6, 0, "again"))
    yield


_PORT = ("port:extensions.satellite.rockblock",)
ROWS = (
    Row(_PORT, "client", "slow", slow_gateways, messages_of_terminal),
    Row(_PORT, "gateway", "slow", slow_bodies, messages_of_terminal),
    Row(_PORT, "terminal", "crash", last_sequence_numbers, messages_of_terminal),
    Row(_PORT, "terminal", "junk", junk_messages, messages_of_terminal),
    Row(_PORT, "terminal", "replay", message_again, messages_of_terminal),
    Row(("exchange:extensions.satellite.rockblock",), "server", "endless", "tests/network/test_http_client.py"),
    Row(("folder:c2.short_messages.*_file",), "a file", "junk", "tests/extensions/satellite/test_chain.py"),
)
