"""One upstream: its queue in the outbox, and its session where it has one of its own."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence

import zenoh

from sonarpost import keys
from sonarpost.delivery.outbox import QueuePolicy
from sonarpost.delivery.records import consumer_of, queue_of
from sonarpost.logs import kv
from sonarpost.services.relay.config import UpstreamOptions

log = logging.getLogger(__name__)

CONSUMER = "c2"
JOIN_S = 0.5

OpenSession = Callable[[Sequence[str], threading.Event], zenoh.Session | None]


def queue_for(site: str) -> str:
    """Return the name of a site's queue; that of `shore` is the one there was before there were several."""
    return CONSUMER if site == keys.SHORE else queue_of(CONSUMER, site)


def is_upstream_queue(queue: str) -> bool:
    """Tell whether a queue is for a site ashore."""
    return consumer_of(queue) == CONSUMER


class Upstream:
    """A site that is to have everything the vessel knows.

    Args:
        config: The site.
        open_session: Opens a session with one of the endpoints, trying until an event is set.
    """

    def __init__(self, config: UpstreamOptions, open_session: OpenSession) -> None:
        self.site = config.site
        self.queue = queue_for(config.site)
        self.max_bytes = config.max_bytes
        self.own_router = config.router
        self._config = config
        self._open_session = open_session
        self._session: zenoh.Session | None = None
        self._thread: threading.Thread | None = None
        self._stop = threading.Event()
        self._lock = threading.Lock()

    def queue_policy(self) -> QueuePolicy:
        """Return how the queue is sent: c2 shows accepted records ashore, a second copy would only load the radio."""
        own = (lambda: self._session) if self._config.router else None
        return QueuePolicy(session=own, publish=False, bytes_per_s=self._config.bandwidth_bytes_per_s)

    @property
    def session(self) -> zenoh.Session | None:
        """The session of its own, None while there is none."""
        return self._session

    def start(self) -> None:
        """Begin to look for the site's router, if the site has one of its own."""
        if self._config.router:
            self._thread = threading.Thread(target=self._open, name=f"upstream-{self.site}", daemon=True)
            self._thread.start()

    def _open(self) -> None:
        session = self._open_session(self._config.router, self._stop)
        with self._lock:
            if session is not None and self._stop.is_set():
                session.close()
                return
            self._session = session
        if session is not None:
            log.info("Router of a site reached", extra=kv(site=self.site, router=", ".join(self._config.router)))

    def stop(self) -> None:
        """Close the session; what is not acknowledged stays in the store."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=JOIN_S)
        with self._lock:
            if self._session is not None:
                self._session.close()
                self._session = None
