"""Carries what the vessel knows ashore, and what the shore says down, over links that come and go."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Collection, Mapping, Sequence

import zenoh

from sonarpost import keys, wire
from sonarpost.bus.connectivity import MonitoredSite, SiteMonitor
from sonarpost.bus.session import open_with_retry
from sonarpost.config import PlatformConfig
from sonarpost.delivery.outbox import QueuePolicy
from sonarpost.delivery.records import InboxItem, Topic
from sonarpost.delivery.store import DiskReserve
from sonarpost.errors import PayloadError
from sonarpost.logs import kv
from sonarpost.messages import Advice, Command, Decision, ReconstructedImage, Record, Relayed
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.upstreams import Upstream, is_upstream_queue

log = logging.getLogger(__name__)

# Advice and commands go on as urgently as they came; a decision is a few bytes that somebody waits for; the first
# version of every picture comes before more detail of any.
COMMAND_PRIORITY = 1
ADVICE_PRIORITY = 2
DECISION_PRIORITY = 2
PREVIEW_PRIORITY = 5
DETAIL_PRIORITY = 6


class RelayService(Service[RelayConfig]):
    """Owes the vessel's records to every site until each has committed them, and the shore's to the vessel.

    Each site has a queue of its own: one that is away for days holds no other back.
    """

    NAME = "relay"
    BATCH = 512

    def __init__(self, platform: PlatformConfig, config: RelayConfig) -> None:
        super().__init__(platform, config)
        upstreams = (Upstream(site, self._open_session) for site in config.sites())
        self._upstreams = {upstream.queue: upstream for upstream in upstreams}
        # By queue: where the site takes what this vessel sends.
        self._inboxes = {queue: keys.shore_inbox(platform.id, u.site) for queue, u in self._upstreams.items()}
        self._watch = SiteMonitor(platform.id, [self._site(u) for u in self._upstreams.values()], platform.tls)
        self._picture_room = DiskReserve(self.store, config.disk_reserve_bytes, "pictures wait with their senders")

    def _site(self, upstream: Upstream) -> MonitoredSite:
        """Return how a site is asked whether it is reached: on the session that leads to it."""
        if upstream.own_router:
            return MonitoredSite(upstream.site, lambda: upstream.session, upstream.own_router)
        return MonitoredSite(upstream.site, lambda: self.session, self.platform.upstream)

    def _open_session(self, endpoints: Sequence[str], stop: threading.Event) -> zenoh.Session | None:
        return open_with_retry(endpoints, stop, self.platform.tls)

    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Pictures and decisions of this vessel, and what the shore says to it."""
        vessel = self.platform.id
        return {
            keys.image_reconstructed(vessel): ReconstructedImage,
            keys.contact_decision(vessel): Decision,
            keys.advice(vessel): Advice,
            keys.command_all(vessel): Command,
        }

    def delivery_only_keys(self) -> Collection[str]:
        """On these keys the vessel's own programs speak to the consumers that this service hands on to."""
        return (keys.advice(self.platform.id), keys.command_all(self.platform.id))

    def check_capacity(self, key: str) -> None:
        """Leave pictures with their senders while the disk is as good as full; what is small is taken for longer."""
        super().check_capacity(key)
        if key == keys.image_reconstructed(self.platform.id):
            self._picture_room.require()

    def validate(self, key: str, record: Record) -> None:
        """Refuse what c2 or nobody on this vessel would take, while its sender can be told."""
        vessel = self.platform.id
        if isinstance(record, Command):
            if key != keys.command(vessel, record.kind):
                raise PayloadError(key, "kind", record.kind, "the kind in the key")
            self._need(self.config.command_consumers, key, "command_consumers")
            return
        assert isinstance(record, (ReconstructedImage, Decision, Advice))
        if record.vessel_id != vessel:
            raise PayloadError(record.TYPE, "vessel_id", record.vessel_id, vessel)
        if isinstance(record, Advice):
            self._need(self.config.advice_consumers, key, "advice_consumers")

    def _need(self, consumers: Sequence[str], key: str, option: str) -> None:
        if not consumers:
            raise PayloadError(key, "", f"nobody who takes it on {self.platform.id}", f"a name in [relay] {option}")

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Owe the record to every site, or to every consumer on the vessel."""
        if isinstance(record, Advice):
            for consumer in self.config.advice_consumers:
                effects.send_payload(key, consumer, effects.payload, Advice, priority=ADVICE_PRIORITY)
            effects.count("advice_taken")
        elif isinstance(record, Command):
            for consumer in self.config.command_consumers:
                effects.send_payload(key, consumer, effects.payload, Command, priority=COMMAND_PRIORITY)
            effects.count("commands_taken")
        else:
            assert isinstance(record, (ReconstructedImage, Decision))
            self._send_ashore(key, record, effects)

    def _send_ashore(self, key: str, record: ReconstructedImage | Decision, effects: UnitOfWork) -> None:
        vessel = self.platform.id
        envelope = Relayed(vessel_id=vessel, key=key, payload=effects.payload, relayed_utc_s=time.time())
        payload = wire.encode(envelope)
        if isinstance(record, Decision):
            priority, topic = DECISION_PRIORITY, None
        else:
            priority = PREVIEW_PRIORITY if record.version == 1 else DETAIL_PRIORITY
            topic = topic_of(record) if self.config.supersede else None
        for queue, inbox in self._inboxes.items():
            effects.send_payload(inbox, queue, payload, Relayed, priority=priority, topic=topic)
        effects.count(f"{record.TYPE}s_relayed")
        log.info("Owed to the shore", extra=kv(record=record.TYPE, sites=len(self._upstreams)))

    def commit_batch(self, handled: Sequence[tuple[UnitOfWork, InboxItem | None]]) -> int:
        """Commit, then keep each site's queue within its quota."""
        superseded = super().commit_batch(handled)
        if superseded:
            self.count("records_superseded", superseded)
        for upstream in self._upstreams.values():
            if upstream.max_bytes is not None:
                self._keep_quota(upstream, upstream.max_bytes)
        return superseded

    def _keep_quota(self, upstream: Upstream, max_bytes: int) -> None:
        if self.store.queue_depth(upstream.queue).size_bytes <= max_bytes:
            return
        with self.store.transaction() as tx:
            dropped = tx.drop_oldest(upstream.queue, max_bytes, DECISION_PRIORITY)
        if dropped:
            self.count("pictures_dropped", dropped)
            log.warning(
                "Pictures dropped for a site, its quota is used up",
                extra=kv(site=upstream.site, pictures=dropped, max_bytes=max_bytes),
            )

    def queue_policy(self, queue: str) -> QueuePolicy:
        """Return how a queue is sent: to a site, or to a consumer on the vessel."""
        if not is_upstream_queue(queue):
            wanted = {*self.config.advice_consumers, *self.config.command_consumers}
            return QueuePolicy(held=queue not in wanted)
        upstream = self._upstreams.get(queue)
        return QueuePolicy(held=True) if upstream is None else upstream.queue_policy()

    def on_start(self) -> None:
        """Look for the sites' own routers; say what waits for sites that are gone."""
        for queue in self._removed_queues():
            depth = self.store.queue_depth(queue)
            if self.config.drop_removed_upstreams:
                with self.store.transaction() as tx:
                    tx.drop_queue(queue)
                log.warning("Records for a removed site dropped", extra=kv(queue=queue, records=depth.records))
        for upstream in self._upstreams.values():
            upstream.start()
        self.start_thread(lambda: self._watch.run(self.stopping), "shore-watch")

    def on_stop(self) -> None:
        """Close the sites' own sessions."""
        for upstream in self._upstreams.values():
            upstream.stop()

    def _removed_queues(self) -> list[str]:
        return [q for q in self.store.queues() if is_upstream_queue(q) and q not in self._upstreams]

    def degraded_reason(self) -> str:
        """Say that pictures wait with their senders for want of space, or that a site does not let this vessel in."""
        return self._picture_room.degraded_reason() or self._watch.degraded_reason()

    def warning(self) -> str:
        """Say which sites are away."""
        return self._watch.warning()

    def gauges(self) -> Mapping[str, float]:
        """Return for each site what waits, how old the oldest of it is, and whether the site answers."""
        found: dict[str, float] = dict(self._watch.gauges())
        for upstream in self._upstreams.values():
            depth = self.store.queue_depth(upstream.queue)
            age_s = 0.0 if depth.oldest_utc_s is None else max(0.0, time.time() - depth.oldest_utc_s)
            found[f"waiting_for_{upstream.site}"] = float(depth.records)
            found[f"waiting_bytes_for_{upstream.site}"] = float(depth.size_bytes)
            found[f"oldest_s_for_{upstream.site}"] = age_s
            found[f"delivered_to_{upstream.site}"] = float(self.acknowledged_count(upstream.queue))
            found[f"answering_{upstream.site}"] = float(self.is_responding(upstream.queue))
        # While it is 0, and the inbox too, every decision is ashore: the console tells people by that.
        urgent = (self.store.queue_depth(queue, DECISION_PRIORITY).records for queue in self._upstreams)
        found["decisions_waiting"] = float(sum(urgent))
        found["held_for_removed"] = float(sum(self.store.queue_depth(q).records for q in self._removed_queues()))
        return found


def topic_of(image: ReconstructedImage) -> Topic:
    """Return what a picture is a version of; the time keeps pictures apart whose vehicle began its identifiers anew."""
    return Topic(f"{image.vehicle_id}/{image.image_id}/{image.first_frame_utc_s!r}", image.version)
