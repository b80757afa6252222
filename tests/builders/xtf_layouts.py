"""XTF files in the layouts of different recorders: the channels of a ping in one packet or in several."""

import struct
from collections.abc import Iterator
from dataclasses import dataclass

from pyxtf import XTFFileHeader, XTFPingChanHeader, XTFPingHeader

FILE_HEADER, PING_HEADER, CHANNEL_HEADER = 1024, 256, 64
CHAN_INFO, CHAN_INFO_BYTES = 256, 128


@dataclass(frozen=True)
class Layout:
    """How the channels of a ping are in packets; channels 0 and 1 are port and starboard of the first frequency.

    Attributes:
        packets: Channels of each packet.
        subchannels: SubChannelNumber of each packet.
        restarts: ChannelNumber counts from 0 in each packet.
        declared: Number of channels in the file header.
        frequency: Where the frequency is: in the `ping`, the `header` of the file, `both`, or `none`.
        consecutive: The packets of a ping have numbers of their own.
        delay_hundredths: Time between the packets of a ping.
    """

    packets: tuple[tuple[int, ...], ...]
    subchannels: tuple[int, ...]
    restarts: bool = False
    declared: int = 0
    frequency: str = "both"
    consecutive: bool = False
    delay_hundredths: int = 0

    def __str__(self) -> str:
        names = [name for name in ("restarts", "consecutive", "delay_hundredths") if getattr(self, name)]
        packets = " ".join("".join(map(str, packet)) for packet in self.packets)
        return f"{packets} sub {''.join(map(str, self.subchannels))} of {self.declared} {self.frequency} {names}"


SIDES = ((0,), (1,))
FREQUENCIES = ((0, 1), (2, 3))
ONE_FREQUENCY = (
    Layout(SIDES, (0, 0)),
    Layout(SIDES, (0, 0), delay_hundredths=3),
    Layout(SIDES, (0, 1)),
    Layout(SIDES, (3, 4), frequency="none"),
    Layout(SIDES, (0, 1), restarts=True, declared=2),
    Layout((*SIDES[::-1],), (1, 0), delay_hundredths=2),
)
TWO_FREQUENCIES = (
    Layout(((0, 1, 2, 3),), (0,), frequency="header"),
    Layout(FREQUENCIES, (0, 0)),
    Layout(FREQUENCIES, (0, 1), frequency="ping"),
    Layout(FREQUENCIES, (0, 1), frequency="header", delay_hundredths=4),
    Layout(FREQUENCIES, (0, 1), frequency="header", restarts=True, declared=4),
    Layout(FREQUENCIES, (0, 0), frequency="ping", restarts=True, declared=2),
    Layout(FREQUENCIES, (0, 1), frequency="ping", restarts=True, declared=2),
    Layout(FREQUENCIES, (0, 1), consecutive=True),
    Layout(FREQUENCIES, (0, 0), consecutive=True, frequency="ping", restarts=True, declared=2),
    Layout(((0, 2), (1, 3)), (0, 1)),
    Layout(((0,), (1,), (2,), (3,)), (0, 0, 0, 0)),
    Layout(((0,), (1,), (2,), (3,)), (0, 1, 0, 1)),
    Layout(((0,), (1,), (2,), (3,)), (0, 1, 2, 3), frequency="header"),
    Layout(((0,), (1,), (2,), (3,)), (0, 1, 2, 3), frequency="header", restarts=True, declared=4),
)
UNNAMED_FREQUENCIES = (
    Layout(((0, 1, 2, 3),), (0,), frequency="none"),
    Layout(FREQUENCIES, (0, 1), frequency="none"),
    Layout(FREQUENCIES, (0, 1), frequency="none", restarts=True, declared=2),
    Layout(FREQUENCIES, (0, 1), frequency="header", restarts=True, declared=2),
    Layout(FREQUENCIES, (0, 0), frequency="none", restarts=True, declared=2),
    Layout(FREQUENCIES, (0, 0), frequency="none", restarts=True, declared=2, consecutive=True),
)
"""Of these, order or range alone tells the frequencies apart."""


def packets_of(raw: bytes) -> Iterator[tuple[bytes, list[bytes]]]:
    """Yield the header of each sonar packet, and its channels with their headers."""
    header = XTFFileHeader.from_buffer_copy(raw)
    offset = FILE_HEADER
    while offset < len(raw):
        head = XTFPingHeader.from_buffer_copy(raw, offset)
        at, channels = offset + PING_HEADER, []
        for _ in range(head.NumChansToFollow):
            channel = XTFPingChanHeader.from_buffer_copy(raw, at)
            size = CHANNEL_HEADER + channel.NumSamples * header.ChanInfo[channel.ChannelNumber].BytesPerSample
            channels.append(raw[at : at + size])
            at += size
        yield raw[offset : offset + PING_HEADER], channels
        offset += head.NumBytesThisRecord


def in_layout(raw: bytes, layout: Layout) -> bytes:
    """Return a file of one packet a ping in another layout."""
    header = bytearray(raw[:FILE_HEADER])
    if layout.declared:
        struct.pack_into("<H", header, 166, layout.declared)
        end = CHAN_INFO + layout.declared * CHAN_INFO_BYTES
        header[end:] = bytes(len(header) - end)
    if layout.frequency in ("ping", "none"):
        for number in range(6):
            struct.pack_into("<f", header, CHAN_INFO + number * CHAN_INFO_BYTES + 32, 0.0)
    chunks = [bytes(header)]
    for head, channels in packets_of(raw):
        chunks += _packets(head, channels, layout)
    return b"".join(chunks)


def _packets(head: bytes, channels: list[bytes], layout: Layout) -> Iterator[bytes]:
    for place, (numbers, subchannel) in enumerate(zip(layout.packets, layout.subchannels, strict=True)):
        body = bytearray()
        for position, number in enumerate(numbers):
            channel = bytearray(channels[number])
            if layout.restarts:
                struct.pack_into("<H", channel, 0, position)
            if layout.frequency in ("header", "none"):
                struct.pack_into("<H", channel, 26, 0)
            body += channel
        own = bytearray(head)
        (ping,) = struct.unpack_from("<I", head, 28)
        own[3], own[21] = subchannel, head[21] + place * layout.delay_hundredths
        struct.pack_into("<I", own, 28, ping * len(layout.packets) + place if layout.consecutive else ping)
        body += bytes(-(PING_HEADER + len(body)) % 64)
        struct.pack_into("<H", own, 4, len(numbers))
        struct.pack_into("<I", own, 10, PING_HEADER + len(body))
        yield bytes(own + body)
