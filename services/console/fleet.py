"""What is known of vehicles and services at this moment; kept in memory, as it is worth nothing later."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass, field

from sonarpost.messages import AcousticFrame, Health, QueueState
from sonarpost.monitoring.fleet import FleetTracker, ServiceStatus
from sonarpost.services.console.store.serialisers import Json

PACKETS_KEPT = 20
MOST_VEHICLES = 200
SILENT_S = 15.0


@dataclass
class _Heard:
    """What was heard of one vehicle; `at_s` of the monotonic clock."""

    frame: AcousticFrame
    at_s: float
    packets: deque[tuple[int, int, int]] = field(default_factory=lambda: deque(maxlen=PACKETS_KEPT))
    frames_at_s: deque[float] = field(default_factory=lambda: deque(maxlen=500))


@dataclass
class _Queue:
    state: QueueState
    at_s: float


class FleetPanel:
    """Collects frames, queues and health, from any thread.

    Args:
        stale_s: A vehicle not heard for so long is stale.
    """

    def __init__(self, stale_s: float) -> None:
        self.services = FleetTracker()
        self._stale_s = stale_s
        self._lock = threading.Lock()
        self._heard: dict[str, _Heard] = {}
        self._queues: dict[str, _Queue] = {}

    def hear(self, vehicle_id: str, frame: AcousticFrame, now_s: float | None = None) -> None:
        """Take a frame of a vehicle that came out of the water; `now_s` is monotonic."""
        now = time.monotonic() if now_s is None else now_s
        with self._lock:
            if vehicle_id not in self._heard and len(self._heard) >= MOST_VEHICLES:
                return
            heard = self._heard.setdefault(vehicle_id, _Heard(frame, now))
            heard.frame, heard.at_s = frame, now
            heard.frames_at_s.append(now)
            quality = frame.quality
            frames = (quality.frames if quality else None) or frame.frame_count or 1
            bad = (quality.bad_frames if quality else None) or 0
            packet = (frame.packet, frames, bad)
            if not heard.packets or heard.packets[-1][0] != frame.packet:
                heard.packets.append(packet)
            else:
                heard.packets[-1] = packet

    def take_queue(self, state: QueueState, now_s: float | None = None) -> None:
        """Take what a vehicle says of its queue."""
        with self._lock:
            if state.platform_id in self._queues or len(self._queues) < MOST_VEHICLES:
                self._queues[state.platform_id] = _Queue(state, time.monotonic() if now_s is None else now_s)

    def rate_of(self, vehicle_id: str, assumed: int | None) -> int | None:
        """Return the rate at which a vehicle was heard last, `assumed` where it was not."""
        with self._lock:
            heard = self._heard.get(vehicle_id)
            rate = None if heard is None else heard.frame.rate
            return assumed if rate is None else rate

    def loss_of(self, vehicle_id: str) -> float | None:
        """Return the share of frames lost lately, None where it is not known."""
        with self._lock:
            heard = self._heard.get(vehicle_id)
            return None if heard is None else _loss(heard)

    def wait_s(self, vehicle_id: str, now_utc_s: float) -> float | None:
        """Return how long the vehicle's queue takes from now on, None where it is not seen."""
        with self._lock:
            queue = self._queues.get(vehicle_id)
            if queue is None:
                return None
            return max((image.expected_utc_s - now_utc_s for image in queue.state.images), default=0.0)

    def link(self, now_s: float | None = None) -> list[Json]:
        """Return what is known of every vehicle's link, by name."""
        now = time.monotonic() if now_s is None else now_s
        with self._lock:
            return [self._vehicle(name, now) for name in sorted({*self._heard, *self._queues})]

    def _vehicle(self, name: str, now: float) -> Json:
        heard, queue = self._heard.get(name), self._queues.get(name)
        age_s = None if heard is None else round(max(0.0, now - heard.at_s), 1)
        quality = heard.frame.quality if heard else None
        return {
            "vehicle_id": name,
            "last_heard_utc_s": heard and heard.frame.time_utc_s,
            "age_s": age_s,
            "stale": age_s is None or age_s > self._stale_s,
            "rate": heard and heard.frame.rate,
            "snr_in_db": quality and quality.snr_in_db,
            "snr_out_db": quality and quality.snr_out_db,
            "frames": sum(packet[1] for packet in heard.packets) if heard else 0,
            "bad_frames": sum(packet[2] for packet in heard.packets) if heard else 0,
            "loss": _loss(heard) if heard else None,
            "frames_per_minute": sum(now - at_s < 60 for at_s in heard.frames_at_s) if heard else 0,
            "queue": None if queue is None else _queue(queue, now, self._stale_s),
        }

    def service_list(self, now_s: float | None = None) -> list[Json]:
        """Return what is known of every service."""
        now = time.monotonic() if now_s is None else now_s
        return [_service(seen) for seen in self.services.state(now).services]


def frame_event(vehicle_id: str, frame: AcousticFrame) -> Json:
    """Return what pages hear of a frame of a vehicle."""
    quality = frame.quality
    return {
        "vehicle_id": vehicle_id,
        "utc_s": frame.time_utc_s,
        "rate": frame.rate,
        "snr_in_db": quality and quality.snr_in_db,
        "snr_out_db": quality and quality.snr_out_db,
        "bytes": len(frame.data),
    }


def _loss(heard: _Heard) -> float | None:
    frames = sum(packet[1] for packet in heard.packets)
    return round(sum(packet[2] for packet in heard.packets) / frames, 3) if frames else None


def _queue(queue: _Queue, now_s: float, stale_s: float) -> Json:
    state = queue.state
    age_s = round(max(0.0, now_s - queue.at_s), 1)
    body = state.model_dump(exclude={"platform_id", "images"})
    images = [image.model_dump() for image in state.images]
    return {**body, "age_s": age_s, "stale": age_s > stale_s, "images": images}


def _service(seen: ServiceStatus) -> Json:
    health: Health | None = seen.health
    stale = seen.age_s is None or seen.age_s > SILENT_S
    state = "silent" if health is None or (stale and health.state != "stopping") else health.state
    return {
        "platform_id": seen.platform,
        "service": seen.service,
        "state": state,
        "detail": health.detail if health else "",
        "time_utc_s": health and health.time_utc_s,
        "age_s": None if seen.age_s is None else round(seen.age_s, 1),
        "stale": stale,
    }
