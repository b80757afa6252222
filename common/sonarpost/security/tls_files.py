"""TLS files of a host: check at the start, with the reason that Zenoh would not report, and monitor of the expiry."""

import logging
import stat
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import serialization

from sonarpost.config import TlsConfig
from sonarpost.errors import ConfigError
from sonarpost.logs import kv
from sonarpost.security.certificates import common_name_of, is_signed_by

log = logging.getLogger(__name__)

WHERE = "platform.tls"


@dataclass(frozen=True, slots=True)
class HostCertificate:
    """Certificate of a host.

    Attributes:
        common_name: Name that identifies the host at other routers.
        not_after: End of the validity.
        warnings: Deficiencies that do not prevent operation, for the log.
    """

    common_name: str
    not_after: datetime
    warnings: tuple[str, ...] = ()

    def days_left(self, now_utc_s: float) -> float:
        """Return the remaining validity in days, negative after its end."""
        return (self.not_after.timestamp() - now_utc_s) / 86400.0


def check_tls_files(tls: TlsConfig, now_utc_s: float) -> HostCertificate:
    """Check that the three files exist, match and are valid at present, and that the key is private.

    Raises:
        ConfigError: A file is invalid; names the setting and the file, never its content.
    """
    authorities = _certificates(tls.ca, "ca")
    own = _certificates(tls.certificate, "certificate")[0]
    warnings = _check_key(tls.key, own)
    signers = [authority for authority in authorities if is_signed_by(own, authority)]
    if not signers:
        issuer, expected = own.issuer.rfc4514_string(), f"issued by the CA in {tls.ca}"
        raise ConfigError(f"{WHERE}.certificate", str(tls.certificate), f"issued by {issuer}", expected)
    _check_validity("certificate", tls.certificate, own, now_utc_s)
    # While a fleet changes its authority, the file also holds the old one, which can expire.
    _check_validity("ca", tls.ca, max(signers, key=lambda signer: signer.not_valid_after_utc), now_utc_s)
    return HostCertificate(common_name_of(own), own.not_valid_after_utc, tuple(warnings))


class TlsMonitor:
    """Monitor of the `[platform] tls` files of a process; without them it reports nothing.

    Raises:
        ConfigError: The files are missing, unreadable, do not match, have expired, or the key is not private. The error
            names the setting and the file, never its content.
    """

    def __init__(self, tls: TlsConfig | None) -> None:
        self._own: HostCertificate | None = None
        self._warn_days = 0.0
        if tls is None:
            return
        now_utc_s = time.time()
        self._warn_days = tls.warn_days
        self._own = check_tls_files(tls, now_utc_s)
        for detail in self._own.warnings:
            log.warning("TLS key readable by its group", extra=kv(detail=detail))
        if warning := self.warning(now_utc_s):
            log.warning("Certificate expires soon", extra=kv(detail=warning))

    def warning(self, now_utc_s: float) -> str:
        """Return that the certificate expires soon; empty if it does not or has expired."""
        if self._own is None or not 0 < (days := self._own.days_left(now_utc_s)) <= self._warn_days:
            return ""
        return f"the certificate {self._own.common_name} ends in {days:.1f} days, on {self._end()}"

    def degraded_reason(self, now_utc_s: float) -> str:
        """Return that the certificate has expired, which prevents new connections; empty if it has not."""
        if self._own is None or self._own.days_left(now_utc_s) > 0:
            return ""
        return f"the certificate {self._own.common_name} has expired on {self._end()}"

    def gauges(self, now_utc_s: float) -> Mapping[str, float]:
        """Return `certificate_days_left`; empty without a certificate."""
        return {} if self._own is None else {"certificate_days_left": self._own.days_left(now_utc_s)}

    def _end(self) -> str:
        assert self._own is not None
        return f"{self._own.not_after:%Y-%m-%d %H:%M} UTC"


def _check_validity(name: str, path: Path, certificate: x509.Certificate, now_utc_s: float) -> None:
    if now_utc_s >= certificate.not_valid_after_utc.timestamp():
        got = f"expired on {certificate.not_valid_after_utc:%Y-%m-%d %H:%M} UTC"
    elif now_utc_s < certificate.not_valid_before_utc.timestamp():
        got = f"valid from {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC only"
    else:
        return
    raise ConfigError(f"{WHERE}.{name}", str(path), got, "a certificate that is valid now (check the clock as well)")


def _certificates(path: Path, name: str) -> Sequence[x509.Certificate]:
    content = _content(path, name)
    if b"PRIVATE KEY" in content:
        raise ConfigError(f"{WHERE}.{name}", str(path), "a private key", "certificates only")
    try:
        return x509.load_pem_x509_certificates(content)
    except ValueError as error:
        raise ConfigError(f"{WHERE}.{name}", str(path), "something else", "PEM certificates") from error


def _check_key(path: Path, own: x509.Certificate) -> list[str]:
    content = _content(path, "key")
    where = f"{WHERE}.key"
    try:
        key = serialization.load_pem_private_key(content, None)
    except TypeError as error:
        expected = "one without a passphrase: Zenoh supports no other"
        raise ConfigError(where, str(path), "a key with a passphrase", expected) from error
    except ValueError as error:
        raise ConfigError(where, str(path), "something else", "a PEM private key") from error
    if key.public_key() != own.public_key():
        raise ConfigError(where, str(path), "the key of another certificate", "the certificate's own key")
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o007:
        raise ConfigError(where, str(path), f"mode {mode:04o}", "a key that others cannot read: chmod 600")
    return [f"{path} is readable by its group (mode {mode:04o})"] if mode & 0o070 else []


def _content(path: Path, name: str) -> bytes:
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:
        if not str(path).isprintable() or "PRIVATE KEY" in str(path):
            # The setting holds the key itself: do not show it.
            raise ConfigError(f"{WHERE}.{name}", "", "no path", "the path of a file") from None
        reason = error.strerror if isinstance(error, OSError) and error.strerror else type(error).__name__
        raise ConfigError(f"{WHERE}.{name}", str(path), reason, "a readable file") from error
