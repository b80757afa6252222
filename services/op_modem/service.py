"""Listens to the vessel's modem, hands every frame on, and speaks to the vehicles."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Mapping

from pydantic import ValidationError

from sonarpost import keys
from sonarpost.config import PlatformConfig
from sonarpost.errors import DeliveryError
from sonarpost.logs import kv
from sonarpost.messages import AcousticFrame, LinkQuality
from sonarpost.modem.micromodem import (
    RATES,
    FrameDecoded,
    FrameReceived,
    LinkStatistics,
    ModemEvent,
    PacketFailed,
    PacketReceived,
    PacketSent,
)
from sonarpost.runtime.service import UnitOfWork
from sonarpost.services.op_modem.arriving import pack, unpack
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.frame_images import image_ids_of_frame
from sonarpost.services.op_modem.orders_service import DownlinkService

log = logging.getLogger(__name__)

_PACKETS = "packets"
_ARRIVING = "arriving"
SAVE_AGAIN_S = 1.0
MAX_UNSAVED = 10_000
MAX_FRAMES = 8


class OpModemService(DownlinkService):
    """The vessel's end of the acoustic link.

    Every frame the modem delivers is taken, also one addressed to somebody else: a picture overheard is a picture.
    The frames of a packet are handed on together, with its statistics; until its end each is kept on the disk as it
    comes. While the disk refuses, they are kept in memory and saved later.

    With `link = "v1"` it also speaks: commands and decisions to vehicles, each until the vehicle has confirmed it or it
    has expired, and reports of what is lacking. What it has heard and what it owes is kept in the transaction of
    whatever changed it.

    Raises:
        ConfigError: The key file cannot be read or is not the owner's alone.
    """

    NAME = "op_modem"

    def __init__(self, platform: PlatformConfig, config: OpModemConfig) -> None:
        super().__init__(platform, config)
        self._quality = LinkQuality()
        self._unsaved: deque[tuple[PacketReceived, float]] = deque()
        self._lock = threading.Lock()

    def on_start(self) -> None:
        """Hand on what a killed process had heard of a packet, and open the port."""
        kept = self.store.get_state(_ARRIVING)
        if (interrupted := unpack(kept) if kept is not None else None) is not None:
            self._keep(*interrupted)
            self._save()
        super().on_start()
        self.start_thread(self._save_later, "save")
        self.begin_speaking()

    def on_stop(self) -> None:
        """Close the port, and try once more to save what is not on the disk yet."""
        super().on_stop()
        self._save()
        if self._unsaved:
            log.error("Packets are lost, the disk refused them to the end", extra=kv(packets=len(self._unsaved)))

    def on_modem_event(self, event: ModemEvent) -> None:
        """Take a packet, whose frames come with it, and before its end each of them."""
        if isinstance(event, (PacketSent, PacketFailed)):
            self._packet_is_over(event)
        elif isinstance(event, FrameDecoded):
            self._turn.heard(time.monotonic())
            self._arriving.append(event.frame)
            self._keep_arriving()
        elif isinstance(event, PacketReceived):
            self._turn.heard(time.monotonic())
            self.count("packets_received")
            self.count("frames_received", len(event.frames))
            self.count("frames_bad", event.bad_frames)
            self._quality = quality_of(event.statistics) or self._quality
            self._arriving = []
            self._keep(event, time.time())
            self._save()

    def gauges(self) -> Mapping[str, float]:
        """Return how many packets are not on the disk yet, and what the modem measured of the last one."""
        measured = {"snr_in_db": self._quality.snr_in_db, "snr_out_db": self._quality.snr_out_db}
        return {
            **super().gauges(),
            "unsaved": float(len(self._unsaved)),
            **self._station_gauges(),
            **{name: value for name, value in measured.items() if value is not None},
        }

    def _keep_arriving(self) -> None:
        try:
            with self.store.transaction() as tx:
                tx.put_state(_ARRIVING, pack(self._arriving, time.time()))
        except DeliveryError as error:
            # They are in memory, and come with their packet; a disk that is full is told then.
            log.warning("Frames of an unfinished packet are not on the disk", extra=kv(error=str(error)))

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
            except DeliveryError as error:
                self.set_degraded(str(error))
                return
        self.set_degraded("")

    def _save_later(self) -> None:
        while not self.stopping.wait(SAVE_AGAIN_S):
            if self._unsaved:
                self._save()

    def _commit_packet(self, packet: PacketReceived, heard_utc_s: float) -> None:
        """Owe a packet's frames to the decompressor, numbered on from the last packet ever received."""
        if not packet.frames:
            return
        number = int(self.store.get_state(_PACKETS) or b"0") + 1
        effects = UnitOfWork()
        key = keys.acoustic_rx(self.platform.id)
        with self._station_lock:
            changed = self._hear(packet, heard_utc_s, effects) if self._speaks else ()
            self._commit_frames(packet, number, heard_utc_s, effects, key)
        self._show(changed, heard_utc_s)
        log.info(
            "Packet received",
            extra=kv(
                source=packet.src,
                rate=packet.rate,
                frames=len(packet.frames),
                bad=packet.bad_frames,
                image_id=",".join(_images_of(packet)) or None,
            ),
        )

    def _commit_frames(
        self, packet: PacketReceived, number: int, heard_utc_s: float, effects: UnitOfWork, key: str
    ) -> None:
        for frame in packet.frames:
            try:
                effects.send(key, "decompressor", self._record(frame, packet, number, heard_utc_s))
            except ValidationError as error:
                # No Micro-Modem sends such a frame: a fault on the serial line that its checksum missed.
                reason = f"frame {frame.frame_number} of {len(frame.data)} bytes: {error.errors()[0]['msg']}"
                log.error("Frame refused", extra=kv(source=frame.src, reason=reason))
                effects.quarantine(key, frame.data, reason)
                effects.count("frames_refused")
        effects.put_state(_PACKETS, str(number).encode())
        # The frames of the next packet may have begun to arrive.
        effects.put_state(_ARRIVING, pack(self._arriving, heard_utc_s))
        self.commit(effects)

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


def _images_of(packet: PacketReceived) -> list[str]:
    """Return the images a packet's frames belong to, as far as their wire format says it."""
    named = [image_ids_of_frame(frame.data) for frame in packet.frames]
    return sorted({image_id for names in named if names is not None for image_id in names.split(",")})


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
