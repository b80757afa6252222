"""Present state of vehicles and services. It is kept in memory and not stored."""

from __future__ import annotations

import math
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field

from sonarpost.detection.difficulty import RELIABLE_PD, unreliable_text
from sonarpost.messages import AcousticFrame, QueueState, VehicleRange
from sonarpost.monitoring.fleet import FleetTracker, ServiceStatus
from sonarpost.review.positions import distance_m
from sonarpost.services.console.chain import SERVICE_STALE_S, ChainHistory, RouterState, chain_links
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.store.serialisers import Json
from sonarpost.services.console.store.tracks import latest_statuses, status_json

PACKETS_KEPT = 20
MAX_VEHICLES = 200
DETECTOR = "atd_stub"
"""Service whose health has the difficulty of the seabed."""


@dataclass
class _Link:
    """Received frames of one vehicle; times of the monotonic clock. Packets: (number, frames, bad frames)."""

    frame: AcousticFrame
    received_s: float
    packets: deque[tuple[int, int, int]] = field(default_factory=lambda: deque(maxlen=PACKETS_KEPT))
    frames_at_s: deque[float] = field(default_factory=lambda: deque(maxlen=500))

    def loss(self) -> float | None:
        """Return the fraction of bad frames of the last packets; None if unknown."""
        frames = sum(packet[1] for packet in self.packets)
        return round(sum(packet[2] for packet in self.packets) / frames, 3) if frames else None


class FleetMonitor:
    """Collects acoustic frames, transmit queues and health, from any thread."""

    def __init__(self) -> None:
        self.services = FleetTracker()
        self.chain_history = ChainHistory()
        self._lock = threading.Lock()
        self._links: dict[str, _Link] = {}
        self._queues: dict[str, QueueState] = {}
        self._ranges: dict[str, VehicleRange] = {}

    def add_frame(self, vehicle_id: str, frame: AcousticFrame, now_s: float | None = None) -> None:
        """Add a frame received from a vehicle; `now_s` is monotonic."""
        now = time.monotonic() if now_s is None else now_s
        with self._lock:
            if vehicle_id not in self._links and len(self._links) >= MAX_VEHICLES:
                return
            link = self._links.setdefault(vehicle_id, _Link(frame, now))
            link.frame, link.received_s = frame, now
            link.frames_at_s.append(now)
            quality = frame.quality
            frames = (quality.frames if quality else None) or frame.frame_count or 1
            bad = (quality.bad_frames if quality else None) or 0
            if link.packets and link.packets[-1][0] == frame.packet:
                link.packets.pop()
            link.packets.append((frame.packet, frames, bad))

    def set_queue(self, state: QueueState) -> None:
        """Store the state of a vehicle's transmit queue."""
        with self._lock:
            if state.platform_id in self._queues or len(self._queues) < MAX_VEHICLES:
                self._queues[state.platform_id] = state

    def set_range(self, record: VehicleRange) -> None:
        """Store the measured distance of a vehicle."""
        with self._lock:
            if record.vehicle_id in self._ranges or len(self._ranges) < MAX_VEHICLES:
                self._ranges[record.vehicle_id] = record

    def measured_ranges(self) -> dict[str, Json]:
        """Return the last measured distance of each vehicle by name."""
        with self._lock:
            return {
                name: {"distance_m": record.distance_m, "measured_utc_s": record.measured_utc_s}
                for name, record in sorted(self._ranges.items())
            }

    def uplink_rate(self, vehicle_id: str, default: int | None) -> int | None:
        """Return the latest rate of a vehicle, or `default` if unknown."""
        with self._lock:
            link = self._links.get(vehicle_id)
            rate = None if link is None else link.frame.rate
            return default if rate is None else rate

    def frame_loss(self, vehicle_id: str) -> float | None:
        """Return the fraction of recently lost frames, 0 to 1; None if unknown."""
        with self._lock:
            link = self._links.get(vehicle_id)
            return None if link is None else link.loss()

    def vehicles(self, now_s: float | None = None) -> dict[str, Json]:
        """Return the link and queue state of all vehicles by name."""
        now = time.monotonic() if now_s is None else now_s
        with self._lock:
            seabeds = self._seabeds(now)
            names = sorted({*self._links, *self._queues, *seabeds})
            return {name: {**self._vehicle_json(name, now), "seabed": seabeds.get(name)} for name in names}

    def _seabeds(self, now: float) -> dict[str, Json]:
        """Return the difficulty of the seabed by vehicle, from the health of its detector."""
        detectors = [status for status in self.services.state(now).services if status.service == DETECTOR]
        known = ((status.platform, _seabed_json(status)) for status in detectors[:MAX_VEHICLES])
        return {name: seabed for name, seabed in known if seabed is not None}

    def _vehicle_json(self, name: str, now: float) -> Json:
        queue, link = self._queues.get(name), self._links.get(name)
        known = {**unknown_vehicle_json(name), "queue": queue and queue.model_dump(exclude={"platform_id"})}
        if link is None:
            return known
        quality = link.frame.quality
        return {
            **known,
            "last_heard_utc_s": link.frame.time_utc_s,
            "rate": link.frame.rate,
            "snr_in_db": quality and quality.snr_in_db,
            "snr_out_db": quality and quality.snr_out_db,
            "frames": sum(packet[1] for packet in link.packets),
            "bad_frames": sum(packet[2] for packet in link.packets),
            "loss": link.loss(),
            "frames_per_minute": sum(now - at_s < 60 for at_s in link.frames_at_s),
        }

    def heard_vehicles(self, now_s: float | None = None) -> dict[str, float]:
        """Return the age of the last received frame by vehicle, in seconds."""
        now = time.monotonic() if now_s is None else now_s
        with self._lock:
            return {name: max(0.0, now - link.received_s) for name, link in sorted(self._links.items())}


def unknown_vehicle_json(name: str) -> Json:
    """Return the state of a vehicle without received frames."""
    unknown = ("last_heard_utc_s", "rate", "snr_in_db", "snr_out_db", "loss", "queue", "seabed")
    return {"vehicle_id": name, **dict.fromkeys(unknown), "frames": 0, "bad_frames": 0, "frames_per_minute": 0}


def _service_json(status: ServiceStatus) -> Json:
    health = status.health
    stale = status.age_s is None or status.age_s > SERVICE_STALE_S
    state: str = "silent"
    if health is None:
        state = "starting" if status.alive else "silent"
    elif not stale or health.state == "stopping":
        state = health.state
    return {
        "platform_id": status.platform,
        "service": status.service,
        "state": state,
        "detail": health.detail if health else "",
        "time_utc_s": health and health.time_utc_s,
        "stale": stale,
    }


def _seabed_json(status: ServiceStatus) -> Json | None:
    """Return the difficulty of the seabed in a detector's health; None if it has no valid expected Pd.

    The gauges come from another platform: a value out of its range is None.
    """
    gauges = status.health.gauges if status.health else {}
    expected_pd = _gauge(gauges, "expected_pd", 1.0)
    if status.health is None or expected_pd is None:
        return None
    return {
        "expected_pd": expected_pd,
        "worst_expected_pd": _gauge(gauges, "worst_expected_pd", 1.0),
        "clutter_per_1000_m2": _gauge(gauges, "clutter_per_1000_m2", math.inf),
        "ripple_strength": _gauge(gauges, "ripple_strength", 1.0),
        "warning": unreliable_text(expected_pd) if expected_pd < RELIABLE_PD else "",
        "time_utc_s": status.health.time_utc_s,
    }


def _gauge(gauges: Mapping[str, float], name: str, highest: float) -> float | None:
    """Return a gauge of 0 to `highest`; None if it is absent or out of that range. A record has finite values only."""
    value = gauges.get(name)
    return value if value is not None and 0.0 <= value <= highest else None


def fleet_json(
    monitor: FleetMonitor,
    db: sqlite3.Connection,
    config: ConsoleConfig,
    router: RouterState | None,
    now_utc_s: float,
) -> Json:
    """Return the state of services, vehicles and chain, with the latest position of each vehicle.

    The connection of the database, which one thread has at a time, also protects the history of the chain.
    """
    positions = {
        row["vehicle_id"]: row
        for row in db.execute(
            "SELECT vehicle_id, vehicle_lat_deg, vehicle_lon_deg, heading_deg,"
            " MAX(COALESCE(seen_utc_s, first_frame_utc_s)) AS seen_utc_s"
            " FROM contact WHERE sealed < 2 AND vehicle_lat_deg IS NOT NULL GROUP BY vehicle_id"
        )
    }
    open_requests = dict(
        db.execute(
            "SELECT c.vehicle_id, COUNT(*) FROM request r JOIN contact c ON c.id = r.contact_id"
            " WHERE r.state IN ('waiting', 'asked', 'sent') GROUP BY c.vehicle_id"
        ).fetchall()
    )
    known, statuses, ranges = monitor.vehicles(), latest_statuses(db), monitor.measured_ranges()
    vehicles: list[Json] = []
    for name in sorted({*known, *positions, *statuses, *ranges}):
        position = _latest_position(positions.get(name), statuses.get(name))
        range_m = None
        if position is not None and config.vessel_lat_deg is not None and config.vessel_lon_deg is not None:
            range_m = round(distance_m(config.vessel_lat_deg, config.vessel_lon_deg, *position[1:3]), 1)
        vehicles.append(
            {
                **(known.get(name) or unknown_vehicle_json(name)),
                "range_m": range_m,
                "position_utc_s": position and position[0],
                "lat_deg": position and position[1],
                "lon_deg": position and position[2],
                "heading_deg": position and position[3],
                "measured_range": ranges.get(name),
                "status": status_json(statuses[name]) if name in statuses else None,
                "open_requests": open_requests.get(name, 0),
            }
        )
    services = monitor.services.state(time.monotonic()).services
    links = chain_links(
        config.role,
        router,
        services,
        monitor.heard_vehicles(),
        sorted(set(config.vehicles.values())),
        now_utc_s=now_utc_s,
        vehicle_stale_s=config.vehicle_stale_s,
    )
    return {
        "now_utc_s": now_utc_s,
        "listening_since_utc_s": router and router.listening_since_utc_s,
        "chain": [asdict(link) for link in monitor.chain_history.with_times(links, now_utc_s)],
        "services": [_service_json(status) for status in services],
        "vehicles": [*vehicles],
    }


def _latest_position(
    contact: sqlite3.Row | None, status: sqlite3.Row | None
) -> tuple[float, float, float, float | None] | None:
    """Return UTC seconds, lat_deg, lon_deg and heading_deg of the last contact or of the status, whichever is newer."""
    found: list[tuple[float, float, float, float | None]] = []
    if contact is not None:
        found.append(
            (contact["seen_utc_s"], *(contact[n] for n in ("vehicle_lat_deg", "vehicle_lon_deg", "heading_deg")))
        )
    if status is not None and status["lat_deg"] is not None:
        found.append(tuple(status[name] for name in ("time_utc_s", "lat_deg", "lon_deg", "heading_deg")))
    return max(found, key=lambda position: position[0], default=None)
