"""A vessel's self-test: is each site reached, and if not, what is in the way.

Zenoh is silent about a refused certificate and about a message that access control stops: records would only wait. The
test asks at the start and now and then, and says in log and health what it met.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import zenoh

from sonarpost.bus import connectivity as reach
from sonarpost.bus.connectivity import ConnectivityResult, ConnectivityState
from sonarpost.config import TlsConfig
from sonarpost.logs import kv

log = logging.getLogger(__name__)

# Every question costs the radio link some hundred bytes.
PROBE_INTERVAL_REACHABLE_S = 120.0
PROBE_INTERVAL_UNREACHABLE_S = (2.0, 5.0, 15.0, 30.0)
# Waiting does not help against these: somebody has to put a certificate or a list right.
FAULTS = (ConnectivityState.TLS_REFUSED, ConnectivityState.DENIED)


@dataclass(frozen=True, slots=True)
class SiteConnectivity:
    """A site that is to be reached.

    Attributes:
        name: Its word in keys.
        session: Returns the session that leads to it, None while there is none.
        endpoints: Routers on the way that this host or its router connects to, tried when nobody answers.
    """

    name: str
    session: Callable[[], zenoh.Session | None]
    endpoints: tuple[str, ...] = ()


class SiteMonitor:
    """Tests the way to every site.

    Args:
        vessel: The platform that asks.
        sites: Whom.
        tls: The host's own certificate.
    """

    def __init__(self, vessel: str, sites: Sequence[SiteConnectivity], tls: TlsConfig | None) -> None:
        self._vessel = vessel
        self._sites = sites
        self._tls = tls
        self._lock = threading.Lock()
        self._outcomes: dict[str, ConnectivityResult] = {}

    def run(self, stop: threading.Event) -> None:
        """Test again and again until `stop` is set."""
        failures = 0
        while not stop.is_set():
            for site in self._sites:
                if stop.is_set():
                    return
                self.note(site.name, self.test(site))
            failures = 0 if self._all_reached() else failures + 1
            stop.wait(
                PROBE_INTERVAL_UNREACHABLE_S[min(failures, len(PROBE_INTERVAL_UNREACHABLE_S)) - 1]
                if failures
                else PROBE_INTERVAL_REACHABLE_S
            )

    def test(self, site: SiteConnectivity) -> ConnectivityResult:
        """Ask one site and, when nobody answers, try the routers on the way."""
        session = site.session()
        if session is None:
            asked = ConnectivityResult(ConnectivityState.UNKNOWN, "its router is not reached")
        else:
            try:
                asked = reach.query_presence(session, self._vessel, site.name)
            except zenoh.ZError as error:
                asked = ConnectivityResult(ConnectivityState.UNKNOWN, str(error)[:200])
        return reach.diagnose_no_reply(asked, site.endpoints, self._tls)

    def note(self, name: str, outcome: ConnectivityResult) -> None:
        """Remember an outcome; log it when it is another than before."""
        with self._lock:
            before = self._outcomes.get(name)
            self._outcomes[name] = outcome
        if before is not None and before.reach is outcome.reach:
            return
        if outcome.reach is ConnectivityState.REACHED:
            log.info("Shore reached", extra=kv(site=name, by=outcome.detail))
        else:
            log.warning("Shore not reached", extra=kv(site=name, why=outcome.reach.value, detail=outcome.detail))

    def degraded_reason(self) -> str:
        """Return what somebody has to put right, empty when nothing."""
        return self._said(lambda outcome: outcome.reach in FAULTS)

    def warning(self) -> str:
        """Return what is away and may come back by itself, empty when nothing."""
        return self._said(
            lambda outcome: outcome.reach not in FAULTS and outcome.reach is not ConnectivityState.REACHED
        )

    def gauges(self) -> Mapping[str, float]:
        """Return for each tested site whether it was reached, 1 or 0."""
        with self._lock:
            return {
                f"reached_{name}": float(o.reach is ConnectivityState.REACHED) for name, o in self._outcomes.items()
            }

    def _all_reached(self) -> bool:
        with self._lock:
            return all(outcome.reach is ConnectivityState.REACHED for outcome in self._outcomes.values())

    def _said(self, wanted: Callable[[ConnectivityResult], bool]) -> str:
        with self._lock:
            return "; ".join(f"{name}: {outcome.text}" for name, outcome in self._outcomes.items() if wanted(outcome))
