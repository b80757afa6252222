"""A process's own certificate: checked when it starts, watched while it runs."""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping

from sonarpost.config import TlsConfig
from sonarpost.logs import kv
from sonarpost.security import tls_files

log = logging.getLogger(__name__)


class TlsMonitor:
    """The `[platform] tls` of a process, or none.

    Raises:
        ConfigError: The files are missing, unreadable, do not fit together, have expired, or the key is not private;
            names the setting and the file, never what is in it.
    """

    def __init__(self, tls: TlsConfig | None) -> None:
        self._warn_days = tls.warn_days if tls is not None else 0.0
        self._own = None
        if tls is None:
            return
        now_utc_s = time.time()
        self._own = tls_files.check(tls.ca, tls.certificate, tls.key, now_utc_s)
        for remark in self._own.remarks:
            log.warning("TLS files", extra=kv(remark=remark))
        if warning := self.warning(now_utc_s):
            log.warning("The certificate ends soon", extra=kv(remark=warning))

    def warning(self, now_utc_s: float) -> str:
        """Return what health says of the certificate's end, empty while it is far away or past."""
        return "" if self._own is None or self.degraded_reason(now_utc_s) else self._warning(now_utc_s)

    def degraded_reason(self, now_utc_s: float) -> str:
        """Return that the certificate has expired, empty while it has not: no new connection comes about then."""
        expired = self._own is not None and self._own.days_left(now_utc_s) <= 0
        return self._warning(now_utc_s) if expired else ""

    def gauges(self, now_utc_s: float) -> Mapping[str, float]:
        """Return `certificate_days_left`, or nothing without a certificate."""
        return {} if self._own is None else {"certificate_days_left": self._own.days_left(now_utc_s)}

    def _warning(self, now_utc_s: float) -> str:
        assert self._own is not None
        return tls_files.expiry_warning(self._own, self._warn_days, now_utc_s)
