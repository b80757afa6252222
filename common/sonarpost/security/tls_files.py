"""Looking at a host's TLS files before Zenoh does: it would only say that a connection timed out."""

from __future__ import annotations

import stat
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import serialization

from sonarpost.errors import ConfigError
from sonarpost.security import x509_files

WHERE = "platform.tls"


@dataclass(frozen=True, slots=True)
class OwnCertificate:
    """What a host's own certificate says.

    Attributes:
        common_name: The name that other routers know the host by.
        serial: Serial number, hexadecimal.
        not_after: End of validity.
        warnings: Deficiencies that do not prevent operation, for the log.
    """

    common_name: str
    serial: str
    not_after: datetime
    warnings: tuple[str, ...] = ()

    def days_left(self, now_utc_s: float) -> float:
        """Return how many days it is still valid, negative when it has expired."""
        return (self.not_after.timestamp() - now_utc_s) / 86400.0


def check(ca: Path, certificate: Path, key: Path, now_utc_s: float) -> OwnCertificate:
    """Check that the three files are there, fit together, are valid now, and that the key is private.

    Raises:
        ConfigError: One of them is not as it must be; names the setting and the file, never its content.
    """
    authorities = _certificates(ca, "ca")
    own = _certificates(certificate, "certificate")[0]
    warnings = _check_key(key, own)
    signers = [authority for authority in authorities if x509_files.signed_by(own, authority)]
    if not signers:
        issuer = own.issuer.rfc4514_string()
        raise ConfigError(f"{WHERE}.certificate", str(certificate), f"issued by {issuer}", f"issued by the CA in {ca}")
    _check_validity("certificate", certificate, own, now_utc_s)
    # While a fleet changes to a new authority, the file holds the old one as well, and that may end.
    _check_validity("ca", ca, max(signers, key=lambda signer: signer.not_valid_after_utc), now_utc_s)
    return OwnCertificate(
        x509_files.common_name_of(own), f"{own.serial_number:x}", own.not_valid_after_utc, tuple(warnings)
    )


def expiry_warning(own: OwnCertificate, warn_days: float, now_utc_s: float) -> str:
    """Return what is to be said about the end of a certificate, empty while it is far away."""
    days = own.days_left(now_utc_s)
    end = f"{own.not_after:%Y-%m-%d %H:%M} UTC"
    if days <= 0:
        return f"the certificate {own.common_name} has expired on {end}"
    if days <= warn_days:
        return f"the certificate {own.common_name} ends in {days:.1f} days, on {end}"
    return ""


def _check_validity(name: str, path: Path, certificate: x509.Certificate, now_utc_s: float) -> None:
    if now_utc_s >= certificate.not_valid_after_utc.timestamp():
        ended = f"expired on {certificate.not_valid_after_utc:%Y-%m-%d %H:%M} UTC"
        raise ConfigError(f"{WHERE}.{name}", str(path), ended, "a certificate that is valid now (check the clock, too)")
    if now_utc_s < certificate.not_valid_before_utc.timestamp():
        begins = f"valid from {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC only"
        raise ConfigError(f"{WHERE}.{name}", str(path), begins, "a certificate that is valid now (check the clock)")


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
        raise ConfigError(where, str(path), "a key with a passphrase", "one without: Zenoh reads no other") from error
    except ValueError as error:
        raise ConfigError(where, str(path), "something else", "a PEM private key") from error
    if key.public_key() != own.public_key():
        raise ConfigError(where, str(path), "the key of another certificate", "the certificate's own key")
    mode = stat.S_IMODE(path.stat().st_mode)
    if mode & 0o007:
        raise ConfigError(where, str(path), f"mode {mode:04o}", "a key that others cannot read: chmod 600")
    return [f"{path} may be read by its group (mode {mode:04o})"] if mode & 0o070 else []


def _content(path: Path, name: str) -> bytes:
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:
        if not str(path).isprintable() or "PRIVATE KEY" in str(path):
            # The key itself was written where its path belongs.
            raise ConfigError(f"{WHERE}.{name}", "", "no path", "the path of a file") from None
        reason = error.strerror if isinstance(error, OSError) and error.strerror else type(error).__name__
        raise ConfigError(f"{WHERE}.{name}", str(path), reason, "a readable file") from error
