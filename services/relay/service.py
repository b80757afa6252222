"""Store-and-forward between a vessel and its shore sites, over intermittent links."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from functools import partial

import zenoh
from typing_extensions import override

from sonarpost import keys, wire
from sonarpost.archive import image_parts
from sonarpost.bus.connectivity import MonitoredSite, SiteMonitor
from sonarpost.bus.session import open_with_retry
from sonarpost.config import PlatformConfig
from sonarpost.delivery.disk_reserve import DiskReserve
from sonarpost.delivery.queue_sender import QueuePolicy
from sonarpost.delivery.records import OutboxItem, Topic, consumer_of, queue_of
from sonarpost.delivery.transaction import Transaction
from sonarpost.errors import PayloadError
from sonarpost.logs import kv, log_batch
from sonarpost.messages import (
    CodedImage,
    Command,
    Comment,
    Decision,
    ImagePart,
    ReceivedStatus,
    Record,
    Relayed,
)
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.services.relay.bearers import bearers
from sonarpost.services.relay.config import RelayConfig, UpstreamOptions

log = logging.getLogger(__name__)

CONSUMER = "c2"
# Comments and commands keep the priority with which they arrived. Decisions are small and urgent. The first version of
# every image precedes more detail of any image.
COMMAND_PRIORITY = 1
COMMENT_PRIORITY = 2
DECISION_PRIORITY = 2
STATUS_PRIORITY = 3
PREVIEW_PRIORITY = 5
DETAIL_PRIORITY = 6
LOGGED_COUNTS = ("coded_images_relayed", "decisions_relayed")
VERSIONS = "version/"
"""Prefix of the states with the last version of an image that a site has acknowledged."""
WHOLES = "whole/"
"""Prefix of the states with the whole image of a queued difference."""


class Upstream:
    """A shore site: its queue, and its session if it has its own router.

    Args:
        options: Configuration of the site.
        platform: The vessel.
    """

    def __init__(self, options: UpstreamOptions, platform: PlatformConfig) -> None:
        self.options = options
        self.inbox = keys.shore_inbox(platform.id, options.site)
        self.part_key = keys.shore_part(platform.id, options.site)
        # The queue of the default site has no site in its name.
        self.queue = CONSUMER if options.site == keys.SHORE else queue_of(CONSUMER, options.site)
        self._tls = platform.tls
        self._session: zenoh.Session | None = None
        self._lock = threading.Lock()

    def queue_policy(self) -> QueuePolicy:
        """Return the settings of the queue. Records are not published: c2 publishes them at the shore."""
        session = self.session if self.options.router else None
        return QueuePolicy(session=session, publish=False, bytes_per_s=self.options.bandwidth_bytes_per_s)

    def session(self) -> zenoh.Session | None:
        """Return the site's own session, None while it is not open."""
        return self._session

    def connect(self, stopping: threading.Event) -> None:
        """Connect to the site's own router; return when it is reached, or when `stopping` is set."""
        session = open_with_retry(self.options.router, stopping, self._tls)
        if session is None:
            return
        with self._lock:
            if stopping.is_set():
                session.close()
                return
            self._session = session
        router = ", ".join(self.options.router)
        log.info("Router of a site reached", extra=kv(site=self.options.site, router=router))

    def close(self) -> None:
        """Close the session; unacknowledged records stay in the store."""
        with self._lock:
            if self._session is not None:
                self._session.close()
                self._session = None


class RelayService(Service[RelayConfig]):
    """Sends the vessel's images and decisions to every shore site, and the shore's records to the vessel's services.

    Each site has its own queue: an unreachable site does not delay the others.
    """

    NAME = "relay"
    BATCH = 512
    MAX_AT_ONCE = 32

    def __init__(self, platform: PlatformConfig, config: RelayConfig) -> None:
        super().__init__(platform, config)
        upstreams = [Upstream(site, platform) for site in config.sites()]
        self._upstreams = {upstream.queue: upstream for upstream in upstreams}
        self._stored_versions = Counter[str]()
        sites = [self._monitored(upstream) for upstream in upstreams]
        self._site_monitor = SiteMonitor(platform.id, sites, platform.tls)
        radio = {upstream.options.site for upstream in upstreams}
        self._added = [
            bearers().get(options.bearer)(options, self, has_radio=options.site in radio) for options in config.added()
        ]
        self._image_reserve = DiskReserve(self.store, config.disk_reserve_bytes, "senders keep their images")

    def _monitored(self, upstream: Upstream) -> MonitoredSite:
        """Return the site with the session and the routers that lead to it."""
        options = upstream.options
        if options.router:
            return MonitoredSite(options.site, upstream.session, options.router)
        return MonitoredSite(options.site, lambda: self.session, self.platform.upstream)

    @override
    def consumed_keys(self) -> Mapping[str, type[Record]]:
        """Images, decisions and statuses of this vessel, comments and commands for it."""
        vessel = self.platform.id
        statuses: dict[str, type[Record]] = {keys.acoustic_status(vessel): ReceivedStatus}
        return {
            **(statuses if self.config.forward_status else {}),
            keys.image_coded(vessel): CodedImage,
            keys.contact_decision(vessel): Decision,
            keys.comment(vessel): Comment,
            keys.command_all(vessel): Command,
        }

    @override
    def delivery_only_keys(self) -> Collection[str]:
        """Plain publications on these keys are for the consumers on the vessel."""
        return (keys.comment(self.platform.id), keys.command_all(self.platform.id))

    @override
    def check_capacity(self, key: str) -> None:
        """Reject images below `disk_reserve_bytes`; other records are small and are accepted for longer."""
        super().check_capacity(key)
        if key == keys.image_coded(self.platform.id):
            self._image_reserve.require()

    @override
    def validate(self, key: str, record: Record) -> None:
        """Refuse records of other vessels, and records without a consumer."""
        vessel = self.platform.id
        if isinstance(record, Command):
            if key != keys.command(vessel, record.kind):
                raise PayloadError(key, "kind", record.kind, "the kind in the key")
            self._require(self.config.command_consumers, key, "command_consumers")
            return
        assert isinstance(record, (CodedImage, Decision, Comment, ReceivedStatus))
        if record.vessel_id != vessel:
            raise PayloadError(record.TYPE, "vessel_id", record.vessel_id, vessel)
        if isinstance(record, Comment):
            self._require(self.config.comment_consumers, key, "comment_consumers")

    def _require(self, consumers: Sequence[str], key: str, option: str) -> None:
        if not consumers:
            raise PayloadError(key, "", f"no consumer on {self.platform.id}", f"a name in [relay] {option}")

    @override
    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        """Queue the record for every site, or for every configured consumer on the vessel."""
        if isinstance(record, Comment):
            for consumer in self.config.comment_consumers:
                effects.send_payload(key, consumer, effects.payload, Comment, priority=COMMENT_PRIORITY)
            effects.count("comments_taken")
        elif isinstance(record, Command):
            for consumer in self.config.command_consumers:
                effects.send_payload(key, consumer, effects.payload, Command, priority=COMMAND_PRIORITY)
            effects.count("commands_taken")
        elif isinstance(record, ReceivedStatus):
            # It replaces older ones of the vehicle.
            topic = Topic(f"status/{record.vehicle_id}", int(1000 * record.received_utc_s))
            self._queue_relayed(key, effects, STATUS_PRIORITY, topic)
            effects.count("statuses_relayed")
        else:
            assert isinstance(record, (CodedImage, Decision))
            for added in self._added:
                added.queue(record, effects)
            if isinstance(record, CodedImage):
                self._queue_image(record, effects)
            else:
                self._queue_relayed(key, effects, DECISION_PRIORITY)
                effects.count("decisions_relayed")
                log.debug("Record queued for the shore", extra=kv(record=Decision.TYPE, sites=len(self._upstreams)))

    def _withdraw(self, item: OutboxItem, site: str) -> None:
        """Withdraw from other bearers a record that the radio has delivered to a site."""
        fields = wire.unpack_map(item.payload, item.key)
        if isinstance(payload := fields.get("payload"), bytes):
            fields = wire.unpack_map(payload, item.key)  # an envelope
        if fields.get("type") == ReceivedStatus.TYPE:
            return  # only the radio sends it
        for added in self._added:
            if added.site == site:
                added.delivered_by_radio(fields)

    def _queue_relayed(self, key: str, effects: UnitOfWork, priority: int, topic: Topic | None = None) -> None:
        """Queue the handled record for each site, in an envelope."""
        envelope = Relayed(vessel_id=self.platform.id, key=key, payload=effects.payload, relayed_utc_s=time.time())
        payload = wire.encode(envelope)
        for upstream in self._upstreams.values():
            effects.send_payload(upstream.inbox, upstream.queue, payload, Relayed, priority=priority, topic=topic)

    def _queue_image(self, image: CodedImage, effects: UnitOfWork) -> None:
        """Queue for each site the difference to the version that it has acknowledged last, or the whole image."""
        whole = image_parts.whole_part(image)
        payload = wire.encode(whole)
        priority = PREVIEW_PRIORITY if image.version == 1 else DETAIL_PRIORITY
        topic = topic_of(image)
        replaces = topic if self.config.supersede else None
        for queue, upstream in self._upstreams.items():
            known = None
            if image.version > 1:
                name = f"{VERSIONS}{queue}/{topic.name}"
                known = image_parts.stored_version(self.store.get_state(name), name)
            found = whole if known is None else image_parts.difference(whole, known)
            sent = payload if found is whole else min(payload, wire.encode(found), key=len)
            is_difference = sent is not payload
            if is_difference:
                # The site may have another version by then, and so may this relay.
                effects.put_state(f"{WHOLES}{queue}/{topic.name}/{image.version}", payload)
            effects.send_payload(upstream.part_key, queue, sent, ImagePart, priority=priority, topic=replaces)
            effects.count("image_differences", int(is_difference))
        effects.count("image_bytes_received", image.bytes_received)
        effects.count("coded_images_relayed")
        log.debug("Image queued for the shore", extra=kv(version=image.version, bytes=len(payload)))

    @override
    def on_acknowledged(self, tx: Transaction, item: OutboxItem, reason: str | None) -> bool:
        """Store which version of an image a site has; send the whole image if the site has refused a difference."""
        upstream = self._upstreams.get(item.queue)
        if self._added and reason is None and upstream is not None:
            self._withdraw(item, upstream.options.site)
        if upstream is None or item.key != upstream.part_key:
            return False
        part = image_parts.head_of(item.payload)
        name = f"{VERSIONS}{item.queue}/{part.subject}"
        if part.version == 1 and reason is None:
            tx.add_state(name, item.payload)  # a stored one is the same version or a later one
            self._prune_versions(tx, item.queue)
            return False
        known = image_parts.stored_number(tx.get_state(name))
        whole = self._take_whole(tx, item, part) if part.base else item.payload
        if whole is None:
            # Deleted for a later version that the site has, or for newer images.
            log.warning("Image version not stored: its whole image was deleted", extra=kv(state=name))
            return reason is not None and known > part.version
        if reason is None:
            if known < part.version:
                tx.put_state(name, whole)
                self._prune_versions(tx, item.queue)
            return False
        if not part.base:
            return False
        topic = Topic(part.subject, part.version) if self.config.supersede else None
        tx.send(item.key, item.queue, whole, encoding=item.encoding, priority=item.priority, topic=topic)
        self.count("image_differences_refused")
        return True

    def _take_whole(self, tx: Transaction, item: OutboxItem, part: image_parts.PartHead) -> bytes | None:
        """Remove and return the whole image of a difference; with `supersede`, remove those of earlier versions too."""
        prefix = f"{WHOLES}{item.queue}/{part.subject}/"
        whole = tx.get_state(f"{prefix}{part.version}")
        for kept in tx.state_names(prefix):
            version = int(kept.removeprefix(prefix))
            if version == part.version or (self.config.supersede and version < part.version):
                tx.delete_state(kept)
        return whole

    def _prune_versions(self, tx: Transaction, queue: str) -> None:
        """Delete surplus versions, except those of images with a queued difference."""
        self._stored_versions[queue] += 1
        if (self._stored_versions[queue] - 1) % image_parts.PRUNE_EVERY == 0:
            prefix = f"{VERSIONS}{queue}/"
            surplus = image_parts.surplus_names(tx.state_names(prefix))
            tx.delete_states(prefix, (name.removeprefix(prefix) for name in surplus), queue)
            # Those of records that were dropped are never taken.
            wholes = {kept: kept.rpartition("/")[0] for kept in tx.state_names(f"{WHOLES}{queue}/")}
            dropped = set(image_parts.surplus_names(list(wholes.values())))
            tx.delete_states("", (kept for kept, image in wholes.items() if image in dropped))

    @override
    def after_commit(self, handled: Sequence[UnitOfWork], superseded: int) -> None:
        """Log the queued records, and apply the quota of each site's queue."""
        super().after_commit(handled, superseded)
        counts = {name: sum(effects.counts.get(name, 0) for effects in handled) for name in LOGGED_COUNTS}
        if any(counts.values()):
            payloads = [effects.payload for effects in handled]
            log_batch(log, "Records queued for the shore", payloads, **{name: n for name, n in counts.items() if n})
        for added in self._added:
            added.committed()
        if superseded:
            self.count("records_superseded", superseded)
        for upstream in self._upstreams.values():
            if upstream.options.max_bytes is not None:
                self._apply_quota(upstream, upstream.options.max_bytes)

    def _apply_quota(self, upstream: Upstream, max_bytes: int) -> None:
        if self.store.queue_depth(upstream.queue).size_bytes <= max_bytes:
            return
        with self.store.transaction() as tx:
            dropped = tx.drop_oldest(upstream.queue, max_bytes, DECISION_PRIORITY)
        if dropped:
            self.count("images_dropped", dropped)
            log.warning(
                "Images dropped: quota of a site exceeded",
                extra=kv(site=upstream.options.site, images=dropped, max_bytes=max_bytes),
            )

    @override
    def queue_policy(self, queue: str) -> QueuePolicy:
        """Return the settings of the queue of a site or of a consumer on the vessel."""
        if not _is_site_queue(queue):
            return QueuePolicy(held=queue not in {*self.config.comment_consumers, *self.config.command_consumers})
        upstream = self._upstreams.get(queue)
        return QueuePolicy(held=True) if upstream is None else upstream.queue_policy()

    @override
    def on_start(self) -> None:
        """Connect to the sites' own routers; drop records of removed sites if configured."""
        for queue in self._removed_queues():
            depth = self.store.queue_depth(queue)
            if self.config.drop_removed_upstreams:
                with self.store.transaction() as tx:
                    tx.drop_queue(queue)
                log.warning("Records dropped: site removed", extra=kv(queue=queue, records=depth.records))
        for upstream in self._upstreams.values():
            if upstream.options.router:
                self.start_thread(partial(upstream.connect, self.stopping), f"upstream-{upstream.options.site}")
        for options, added in zip(self.config.added(), self._added, strict=True):
            self.start_thread(partial(added.run, self.stopping), f"{options.bearer}-{options.site}")
        self.start_thread(lambda: self._site_monitor.run(self.stopping), "site-monitor")

    @override
    def on_stop(self) -> None:
        """Close the sites' own sessions and the other bearers."""
        for added in self._added:
            added.stop()
        for upstream in self._upstreams.values():
            upstream.close()

    def _removed_queues(self) -> list[str]:
        return [queue for queue in self.store.queues() if _is_site_queue(queue) and queue not in self._upstreams]

    @override
    def degraded_reason(self) -> str:
        """Return that no images are accepted, or which site denies this vessel."""
        return self._image_reserve.degraded_reason() or self._site_monitor.degraded_reason()

    @override
    def warning(self) -> str:
        """Return which sites are not reached, and what prevents sending by other bearers."""
        warnings = (self._site_monitor.warning(), *(added.warning() for added in self._added))
        return "; ".join(warning for warning in warnings if warning)

    @override
    def gauges(self) -> Mapping[str, float]:
        """Return queue depth, age of the oldest record and responsiveness of each site."""
        found: dict[str, float] = dict(self._site_monitor.gauges())
        for queue, upstream in self._upstreams.items():
            site = upstream.options.site
            depth = self.store.queue_depth(queue)
            age_s = 0.0 if depth.oldest_utc_s is None else max(0.0, time.time() - depth.oldest_utc_s)
            found[f"waiting_for_{site}"] = float(depth.records)
            found[f"waiting_bytes_for_{site}"] = float(depth.size_bytes)
            found[f"oldest_s_for_{site}"] = age_s
            found[f"delivered_to_{site}"] = float(self.acknowledged_count(queue))
            found[f"answering_{site}"] = float(self.is_responding(queue))
        for added in self._added:
            found |= added.gauges()
        # The console shows by this gauge and the inbox whether every decision has reached the shore.
        urgent = (self.store.queue_depth(queue, DECISION_PRIORITY).records for queue in self._upstreams)
        found["decisions_waiting"] = float(sum(urgent))
        found["held_for_removed"] = float(sum(self.store.queue_depth(q).records for q in self._removed_queues()))
        return found


def _is_site_queue(queue: str) -> bool:
    return consumer_of(queue) == CONSUMER


def topic_of(image: CodedImage) -> Topic:
    """Return the topic of an image's versions; the time distinguishes images after a restart of the identifiers."""
    name = image_parts.subject(image.vehicle_id, image.image_id, image.first_frame_utc_s)
    return Topic(name, image.version)
