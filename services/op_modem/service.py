"""Listens to the vessel's modem and hands every frame on."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Mapping

from pydantic import ValidationError

from services.op_modem.config import OpModemConfig
from sonarpost import keys
from sonarpost.errors import HandoffError
from sonarpost.messages import AcousticFrame, LinkQuality, Record
from sonarpost.modem.events import Event, FrameReceived, PacketReceived
from sonarpost.modem.rates import RATES
from sonarpost.modem.statistics import LinkStatistics
from sonarpost.runtime.config import PlatformConfig
from sonarpost.runtime.logs import kv
from sonarpost.runtime.modem_service import ModemService
from sonarpost.runtime.service import Effects

log = logging.getLogger(__name__)

_PACKETS = "packets"
SAVE_AGAIN_S = 1.0
MAX_UNSAVED = 10_000
MAX_FRAMES = 8


class OpModemService(ModemService[OpModemConfig]):
    """The vessel's end of the acoustic link.

    Every frame the modem delivers is taken, also one addressed to somebody else: a picture overheard is a picture.
    The frames of a packet are committed together. While the disk refuses, they are kept in memory and saved later.
    """

    NAME = "op_modem"

    def __init__(self, platform: PlatformConfig, config: OpModemConfig) -> None:
        super().__init__(platform, config)
        self._unsaved: deque[tuple[PacketReceived, float]] = deque()
        self._lock = threading.Lock()

    def handle(self, key: str, record: Record, effects: Effects) -> None:
        """Refuse: nothing is sent to this service."""
        raise NotImplementedError("op_modem consumes no records")

    def on_start(self) -> None:
        """Open the port."""
        super().on_start()
        self.spawn(self._save_later, "save")

    def on_stop(self) -> None:
        """Close the port, and try once more to save what is not on the disk yet."""
        super().on_stop()
        self._save()
        if self._unsaved:
            log.error("Packets are lost, the disk refused them to the end", extra=kv(packets=len(self._unsaved)))

    def on_modem_event(self, event: Event) -> None:
        """Take a packet; its frames come with it."""
        if isinstance(event, PacketReceived):
            self.count("packets_received")
            self.count("frames_received", len(event.frames))
            self.count("frames_bad", event.bad_frames)
            self._keep(event, time.time())
            self._save()

    def gauges(self) -> Mapping[str, float]:
        """Return how many packets are not on the disk yet."""
        return {**super().gauges(), "unsaved": float(len(self._unsaved))}

    def _keep(self, packet: PacketReceived, heard_utc_s: float) -> None:
        with self._lock:
            if len(self._unsaved) >= MAX_UNSAVED:
                self._unsaved.popleft()
                self.count("packets_lost")
                log.error("The oldest unsaved packet is lost", extra=kv(unsaved=len(self._unsaved)))
            self._unsaved.append((packet, heard_utc_s))

    def _save(self) -> None:
        with self._lock:
            try:
                while self._unsaved:
                    self._commit_packet(*self._unsaved[0])
                    self._unsaved.popleft()
            except HandoffError as error:
                self.problem(str(error))
                return
        self.problem("")

    def _save_later(self) -> None:
        while not self.stopping.wait(SAVE_AGAIN_S):
            if self._unsaved:
                self._save()

    def _commit_packet(self, packet: PacketReceived, heard_utc_s: float) -> None:
        """Owe a packet's frames to the decompressor, numbered on from the last packet ever received."""
        if not packet.frames:
            return
        number = int(self.store.get_state(_PACKETS) or b"0") + 1
        effects = Effects()
        key = keys.acoustic_rx(self.platform.id)
        for frame in packet.frames:
            try:
                effects.send(key, "decompressor", self._record(frame, packet, number, heard_utc_s))
            except ValidationError as error:
                # No Micro-Modem sends such a frame: a fault on the serial line that its checksum missed.
                reason = f"frame {frame.frame_number} of {len(frame.data)} bytes: {error.errors()[0]['msg']}"
                log.error("Frame refused", extra=kv(source=frame.src, reason=reason))
                effects.keep_apart(key, frame.data, reason)
                effects.count("frames_refused")
        effects.put_state(_PACKETS, str(number).encode())
        self.commit(effects)
        log.info(
            "Packet received",
            extra=kv(source=packet.src, rate=packet.rate, frames=len(packet.frames), bad=packet.bad_frames),
        )

    def _record(self, frame: FrameReceived, packet: PacketReceived, number: int, heard_utc_s: float) -> AcousticFrame:
        return AcousticFrame(
            direction="rx",
            platform_id=self.platform.id,
            time_utc_s=heard_utc_s,
            source=frame.src,
            destination=frame.dest,
            rate=frame.rate if frame.rate in RATES else None,
            packet=number,
            frame_number=frame.frame_number,
            frame_count=_within(packet.nframes, MAX_FRAMES),
            data=frame.data,
            quality=quality_of(packet.statistics),
        )


def quality_of(statistics: LinkStatistics | None) -> LinkQuality | None:
    """Return the part of the modem's statistics that travels with a frame."""
    if statistics is None:
        return None
    return LinkQuality(
        snr_in_db=statistics.snr_in_db,
        snr_out_db=statistics.snr_out_db,
        spl_db=None if statistics.spl_db is None else float(statistics.spl_db),
        mse_db=statistics.mse_db,
        doppler=statistics.doppler,
        frames=_within(statistics.nframes),
        bad_frames=_within(statistics.nbad),
    )


def _within(number: int | None, high: int | None = None) -> int | None:
    """Return a count the modem has told, None where it is none."""
    return number if number is not None and number >= 0 and (high is None or number <= high) else None
