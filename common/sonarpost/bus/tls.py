"""Monitor of a process's own TLS certificate: validity at the start, expiry while it runs."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping

from sonarpost.config import TlsConfig
from sonarpost.logs import kv
from sonarpost.security import tls_files

log = logging.getLogger(__name__)


class TlsMonitor:
    """Monitor of the `[platform] tls` files of a process; without them it reports nothing.

    Raises:
        ConfigError: The files are missing, unreadable, do not match, have expired, or the key is not private. The error
            names the setting and the file, never its content.
    """

    def __init__(self, tls: TlsConfig | None) -> None:
        self._warn_days = tls.warn_days if tls is not None else 0.0
        self._own = None
        if tls is None:
            return
        now_utc_s = time.time()
        self._own = tls_files.check(tls.ca, tls.certificate, tls.key, now_utc_s)
        for detail in self._own.warnings:
            log.warning("TLS key readable by its group", extra=kv(detail=detail))
        if warning := self.warning(now_utc_s):
            log.warning("Certificate expires soon", extra=kv(detail=warning))

    def warning(self, now_utc_s: float) -> str:
        """Return that the certificate expires soon; empty if it does not or has expired."""
        return "" if self._own is None or self.degraded_reason(now_utc_s) else self._warning(now_utc_s)

    def degraded_reason(self, now_utc_s: float) -> str:
        """Return that the certificate has expired, which prevents new connections; empty if it has not."""
        expired = self._own is not None and self._own.days_left(now_utc_s) <= 0
        return self._warning(now_utc_s) if expired else ""

    def gauges(self, now_utc_s: float) -> Mapping[str, float]:
        """Return `certificate_days_left`; empty without a certificate."""
        return {} if self._own is None else {"certificate_days_left": self._own.days_left(now_utc_s)}

    def _warning(self, now_utc_s: float) -> str:
        assert self._own is not None
        return tls_files.expiry_warning(self._own, self._warn_days, now_utc_s)
