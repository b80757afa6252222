"""Records that every service can publish: health, and the outcome of a relayed record."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field

from sonarpost.messages.record import Count, PlatformId, Record, ServiceState, Text, Time


class Relayed(Record):
    """Envelope of a record that a vessel sends to a shore site.

    Attributes:
        vessel_id: Must be the vessel of the inner key and record.
        key: Key of the inner record: this vessel's `contact/decision` or `acoustic/status`, or `image/reconstructed`
            for a preview from short messages and for a replayed recording.
        payload: The inner record, unchanged, with its `type` and `v`.
        relayed_utc_s: When the relay accepted it.
    """

    TYPE: ClassVar[str] = "relayed"

    vessel_id: PlatformId
    key: Annotated[str, Field(min_length=1, max_length=300)]
    payload: bytes
    relayed_utc_s: Time


class Health(Record):
    """A service's state, published every `health_interval_s` (5 s by default) and when the service stops.

    Attributes:
        platform_id: Platform of the service.
        service: Name of the service.
        time_utc_s: Time of this record.
        started_utc_s: Start of the process.
        state: degraded: the service runs, but something prevents part of its work.
        detail: What is wrong; empty if nothing is.
        counters: Events since the start, `records_handled` and `records_refused` among them.
        gauges: Present values. `inbox`, `outbox` and `refused` are numbers of records in the service's store,
            `disk_free_bytes` is the free space on its disk (absent if it cannot be read).
    """

    TYPE: ClassVar[str] = "health"

    platform_id: PlatformId
    service: Annotated[str, Field(min_length=1, max_length=40)]
    time_utc_s: Time
    started_utc_s: Time
    state: ServiceState
    detail: Text = ""
    counters: dict[str, Count]
    gauges: dict[str, float]
