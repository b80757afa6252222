"""A host that uses its modem like Goby3's Micro-Modem driver: start, waits, retries and delivery.

Goby cannot be built here; the host follows its source and test program. A command waits in a queue for the sentence
that answers it, a setting for an echo of all three parts. After five seconds without an answer the command is sent
again; five failures in all mean that the modem is dead. The start ends when the clock is within a second. A reception
is delivered with its statistics. The host runs at 10 Hz on simulated time.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta

from sonarpost.modem.micromodem import nmea

FRAMES = (1, 3, 3, 2, 2, 8)
FRAME_BYTES = (32, 64, 64, 256, 256, 256)
ALLOWED_SKEW_S = 1.0


@dataclass
class Delivery:
    """One received transmission, as delivered to the application."""

    kind: str = ""
    src: int | None = None
    dest: int | None = None
    rate: int | None = None
    frames: list[bytes] = field(default_factory=list)
    acked: list[int] = field(default_factory=list)
    travel_times_s: list[float | None] = field(default_factory=list)
    modem_time: str = ""
    modes: list[int] = field(default_factory=list)


class GobyHost:
    """One host.

    Args:
        address: Address of its modem.
        mm: Generation of its modem, 1 or 2.
        true_utc_s: UTC at simulated time zero.
        settings: Further settings.
    """

    def __init__(self, address: int, mm: int, true_utc_s: float, settings: tuple[str, ...] = ()) -> None:
        self.address = address
        self.true_at_zero = datetime.fromtimestamp(true_utc_s, UTC)
        self.major: int | None = None
        self.clock_set = False
        self.clock_settings = 0
        self.started = False
        self.dead = False
        self.given_up: list[str] = []
        self.resent = 0
        self.to_modem = b""
        self.delivered: list[Delivery] = []
        self.results = 0
        self.raw: list[str] = []
        self._out: deque[nmea.Sentence] = deque()
        self._waiting = False
        self._written_s = 0.0
        self._fails = 0
        self._present_fails = 0
        self._paused_until_s = 0.0
        self._last_sentence_s = -1e9
        self._dump_s: float | None = None
        self._received = b""
        self._message = Delivery()
        self._expected_cst = 0
        self._expected_xst = 0
        self._local_cycle = False
        self._packet: tuple[int, int, int, bool, list[bytes]] | None = None
        self._waiting_acks: set[int] = set()
        self._ack_from = 0
        self._next_frame = 0
        self._ranging = ""
        self.nvram: dict[str, str] = {}
        self.uplink: list[bytes] = []
        if mm == 1:
            self.configure("ALL,0")
        for setting in ("CST,1", *settings, f"SRC,{address}", "REV,1", "RXP,1"):
            self.configure(setting)
        self._put("CCMSC", address, address, 0)

    # Requests of an application.

    def configure(self, setting: str) -> None:
        self._put("CCCFG", *setting.split(","))

    def ping(self, dest: int) -> None:
        self._put("CCMPC", self.address, dest)

    def mini(self, dest: int, data: bytes) -> None:
        self._put("CCMUC", self.address, dest, data.hex())

    def flexible(self, dest: int, rate: int, data: bytes) -> None:
        self._put("CCTDP", dest, rate, 0, 0, data.hex())

    def send(self, dest: int, rate: int, frames: list[bytes], ack: bool) -> None:
        self._packet = (self.address, dest, rate, ack, frames)
        self._local_cycle = True
        self._waiting_acks.clear()
        self._next_frame = 0
        self._put("CCCYC", 0, self.address, dest, rate, int(ack), len(frames))
        self._expected_xst = int(rate == 0)

    def poll_for(self, src: int, rate: int) -> None:
        self._local_cycle = True
        self._put("CCCYC", 0, src, self.address, rate, 1, FRAMES[rate])
        self._expected_xst = 0

    def range_remus(self, max_range_m: float, turnaround_ms: int = 50, beacons: int = 7) -> None:
        self._ranging = "remus"
        self._turnaround(turnaround_ms)
        timeout_ms = int(max_range_m * 2 / 1500 * 1000 + turnaround_ms)
        self._put("CCPDT", 1, self.address % 4 + 1, 0, 0, timeout_ms, *(beacons >> n & 1 for n in range(4)))

    def range_narrow(self, max_range_m: float, turnaround_ms: int) -> None:
        self._ranging = "narrow"
        self._turnaround(turnaround_ms)
        timeout_ms = int(max_range_m * 2 / 1500 * 1000 + turnaround_ms)
        self._put("CCPNT", 26000, 5, 5, timeout_ms, 25000, 0, 0, 0, 1)

    def query_everything(self) -> None:
        self._put("CCCFQ", "TOP" if (self.major or 0) >= 2 else "ALL")
        self._dump_s = -1.0

    def _turnaround(self, turnaround_ms: int) -> None:
        if self.nvram.get("TAT") != str(turnaround_ms):
            self.configure(f"TAT,{turnaround_ms}")

    # Called ten times a second.

    def work(self, now: float, received: bytes) -> None:
        self._received += received
        if now < self._paused_until_s or self.dead:
            return
        if self._dump_s is not None and self._waiting and now >= max(self._dump_s, self._written_s) + 2.0:
            self._dump_s = None
            self._pop()
        self._clock(now)
        if now >= self._last_sentence_s + 10.0:
            self._put(*(("CCTMQ", 0) if (self.major or 0) >= 2 else ("CCCFQ", "SRC")))
            self._last_sentence_s = now
        self._try_send(now)
        while now >= self._paused_until_s and b"\r\n" in self._received:
            line, _, self._received = self._received.partition(b"\r\n")
            self._take(line, now)

    def _clock(self, now: float) -> None:
        true = self.true_at_zero + timedelta(seconds=now)
        if self._out or self.clock_set or not 0.05 <= true.microsecond / 1e6 <= 0.15:
            self.started |= self.clock_set and not self._out
            return
        self.clock_settings += 1
        if (self.major or 0) >= 2:
            self._put("CCTMS", (true + timedelta(seconds=1)).strftime("%Y-%m-%dT%H:%M:%SZ"), 0)
        else:
            self._put("CCCLK", true.year, true.month, true.day, true.hour, true.minute, true.second + 1)
            self._try_send(now)
            self._paused_until_s = now + 1.0

    def _put(self, kind: str, *fields: str | int) -> None:
        self._out.append(nmea.Sentence(kind, tuple(str(f) for f in fields)))

    def _try_send(self, now: float) -> None:
        if not self._out:
            return
        if not self._waiting:
            self._write(now)
        elif self._dump_s is None and now >= self._written_s + 5.0:
            self._fails += 1
            self.resent += 1
            self.dead = self._fails >= 5
            self._fail()
            if self._waiting:
                self._write(now)

    def _write(self, now: float) -> None:
        self.to_modem += self._out[0].encode()
        self._waiting, self._written_s = True, now

    def _fail(self) -> None:
        self._present_fails += 1
        if self._present_fails >= 3:
            self.given_up.append(",".join((self._out[0].kind, *self._out[0].fields)))
            self._pop()

    def _pop(self) -> None:
        self._waiting = False
        self._present_fails = 0
        self._out.popleft()

    # Sentences of the modem.

    def _take(self, line: bytes, now: float) -> None:
        sentence = nmea.parse(line, checksum_required=True)
        self.raw.append(line.decode())
        self._last_sentence_s, self._fails = now, 0
        handler = getattr(self, f"_on_{sentence.kind[2:].lower()}", None)
        if handler is not None:
            handler(sentence.fields, now)
        if not self._out or not self._waiting:
            return
        waiting, id_ = self._out[0], sentence.kind[2:]
        if waiting.kind == "CCCFG":
            done = id_ == "CFG" and sentence.fields == waiting.fields
        elif waiting.kind == "CCCFQ" and id_ == "CFG":
            if self._dump_s is not None:
                self._dump_s = now
            done = self._dump_s is None
        elif waiting.kind == "CCMSC":
            done = id_ in {"REV", "MSC"}
        else:
            done = waiting.kind[2:] == id_
        if done:
            self._pop()

    def _on_rev(self, f: tuple[str, ...], now: float) -> None:
        if f[1] == "INIT":
            self._paused_until_s = now + 2.0
            self.clock_set = False
        elif f[1] == "AUV":
            self.major = int(f[2].split(".")[0])

    def _on_err(self, f: tuple[str, ...], now: float) -> None:
        if f[1] == "NMEA" and self._out:
            self._waiting = False
            self._fail()

    def _on_cfg(self, f: tuple[str, ...], now: float) -> None:
        self.nvram[f[0]] = f[1]

    def _time(self, reported: datetime, now: float) -> None:
        skew_s = (reported - self.true_at_zero).total_seconds() - now
        self.clock_set = abs(skew_s) < ALLOWED_SKEW_S

    def _on_clk(self, f: tuple[str, ...], now: float) -> None:
        if self._out and self._out[0].kind == "CCCLK":
            y, mo, d, h, mi, s = map(int, f[:6])
            self._time(datetime(y, mo, d, h, mi, tzinfo=UTC) + timedelta(seconds=s), now)

    def _on_tms(self, f: tuple[str, ...], now: float) -> None:
        if self._out and self._out[0].kind == "CCTMS":
            self._time(datetime.fromisoformat(f[1]), now)

    def _on_tmq(self, f: tuple[str, ...], now: float) -> None:
        if self._out and self._out[0].kind == "CCTMQ":
            self._time(datetime.fromisoformat(f[0]) + timedelta(seconds=0.5), now)

    def _on_cyc(self, f: tuple[str, ...], now: float) -> None:
        src, dest, rate, frames = int(f[1]), int(f[2]), int(f[3]), int(f[5])
        if src == self.address:
            if not self._local_cycle:
                self._packet = (src, dest, rate, True, self.uplink[:frames])
                self._waiting_acks.clear()
                self._next_frame = 0
            self._local_cycle = False
        elif self._local_cycle and rate != 0:
            self._local_cycle = False
        else:
            self._expected_cst = int(rate == 0 and not self._local_cycle)
            self._local_cycle = False

    def _on_drq(self, f: tuple[str, ...], now: float) -> None:
        number = int(f[5]) - 1
        if self._packet is None or number >= len(self._packet[4]):
            self._put("CCTXD", f[1], f[2], f[3], "")
            return
        src, dest, _, ack, frames = self._packet
        self._put("CCTXD", src, dest, int(ack), frames[number].ljust(int(f[4]), b"\0").hex())
        if ack:
            self._ack_from = dest
            self._waiting_acks.add(self._next_frame)
            self._next_frame += 1

    def _on_xst(self, f: tuple[str, ...], now: float) -> None:
        assert f[0] == "6", "Goby reads any other version as the first"
        if self._expected_xst:
            self._expected_xst -= 1
        else:
            self.results += 1
            self._packet = None

    def _on_rxd(self, f: tuple[str, ...], now: float) -> None:
        m = self._message
        if f[3] == "1":
            m.kind, m.src, m.dest = "data", int(f[0]), int(f[1])
        m.frames.append(bytes.fromhex(f[4]))

    def _on_ack(self, f: tuple[str, ...], now: float) -> None:
        if int(f[1]) != self.address or int(f[0]) != self._ack_from:
            return
        number = int(f[2]) - 1
        if number in self._waiting_acks:
            self._waiting_acks.remove(number)
            m = self._message
            m.kind, m.src, m.dest = "ack", int(f[0]), int(f[1])
            m.acked.append(number)

    def _on_mua(self, f: tuple[str, ...], now: float) -> None:
        self._message = Delivery("mini", int(f[0]), int(f[1]), frames=[bytes.fromhex(f[2])])

    def _on_mpa(self, f: tuple[str, ...], now: float) -> None:
        self._message = Delivery("ping", int(f[0]), int(f[1]))

    def _on_mpr(self, f: tuple[str, ...], now: float) -> None:
        self._message = Delivery("ping", int(f[0]), int(f[1]), travel_times_s=[float(f[2])])

    def _on_rdp(self, f: tuple[str, ...], now: float) -> None:
        parts = [part for group in f[5:7] if group for part in group.split(";")]
        assert all(crc == "1" for crc in parts[::3])
        data = b"".join(bytes.fromhex(part) for part in parts[2::3])
        self._message = Delivery("flexible", int(f[0]), int(f[1]), int(f[2]), frames=[data])

    def _on_tta(self, f: tuple[str, ...], now: float) -> None:
        m = self._message
        m.kind, m.src, m.modem_time = self._ranging, self.address, f[4]
        m.travel_times_s = [float(t) if t else None for t in f[:4]]
        self._deliver()

    def _on_cst(self, f: tuple[str, ...], now: float) -> None:
        assert f[0] == "6", "Goby reads any other version as the first"
        self._message.modes.append(int(f[1]))
        if self._expected_cst:
            self._expected_cst -= 1
        else:
            self._deliver()

    def _deliver(self) -> None:
        self.delivered.append(self._message)
        self._message = Delivery()
