"""A fleet's certificate authority in a folder: make it, issue, renew, revoke.

    {folder}/             0700
      ca.pem              0644  the authority's certificate, on every host
      ca.key              0600  its key: on this machine only
      index.json          0600  every certificate ever issued
      issued/{name}/      0700  what one host needs: ca.pem, certificate.pem, key.pem (0600)

The index is written before a certificate is handed out, so that there is none the index does not know.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from sonarpost.errors import BadInputError
from sonarpost.files import write_atomically
from sonarpost.security import names, private_files, x509_files
from sonarpost.security.index import INDEX_FILE, FleetIndex, Issued, PkiError, Role
from sonarpost.security.private_files import PRIVATE_FILE, PUBLIC_FILE

CA_CERTIFICATE = "ca.pem"
CA_KEY = "ca.key"
CERTIFICATE = "certificate.pem"
KEY = "key.pem"
ISSUED = "issued"
AUTHORITY_DAYS = 3650
CERTIFICATE_DAYS = 365.0
MIN_PASSPHRASE_BYTES = 8

Passphrase = Callable[[], bytes]


@dataclass(frozen=True, slots=True)
class Bundle:
    """A certificate that was just made, and the folder that holds it."""

    entry: Issued
    folder: Path


class Fleet:
    """The authority in a folder.

    Args:
        folder: Where it is.
        passphrase: Asked for the key's passphrase when the key has one.
        now_utc_s: The clock.
    """

    def __init__(self, folder: Path, passphrase: Passphrase, now_utc_s: Callable[[], float] = time.time) -> None:
        self.folder = folder
        self._passphrase = passphrase
        self._now_utc_s = now_utc_s

    @classmethod
    def init(
        cls,
        folder: Path,
        fleet: str,
        passphrase: bytes | None = None,
        days: int = AUTHORITY_DAYS,
        now_utc_s: Callable[[], float] = time.time,
    ) -> Fleet:
        """Make an authority in a new folder.

        Args:
            folder: Must not be there yet.
            fleet: Name of the fleet, for people.
            passphrase: Protects the authority's key; None keeps it in the clear (mode 0600).
            days: Validity of the authority.
            now_utc_s: The clock.

        Raises:
            PkiError: The folder is there, the name is empty or too long, the passphrase too short.
            OSError: It cannot be written.
        """
        if not 1 <= len(fleet) <= 48 or not fleet.isprintable():
            raise PkiError("pki", "fleet", fleet, "1 to 48 printable characters")
        if passphrase is not None and len(passphrase) < MIN_PASSPHRASE_BYTES:
            got = f"{len(passphrase)} bytes"
            raise PkiError("pki", "passphrase", got, f"at least {MIN_PASSPHRASE_BYTES} bytes")
        _, certificate_pem, key_pem = x509_files.new_authority(fleet, days, x509_files.utc(now_utc_s()), passphrase)
        files = {
            CA_CERTIFICATE: (certificate_pem, PUBLIC_FILE),
            CA_KEY: (key_pem, PRIVATE_FILE),
            INDEX_FILE: (FleetIndex(fleet=fleet).to_bytes(), PRIVATE_FILE),
        }
        try:
            private_files.write_new_folder(folder, files)
        except FileExistsError as error:
            raise PkiError(str(folder), "", "something there already", "a folder that is not there yet") from error
        return cls(folder, lambda: passphrase or b"", now_utc_s)

    def index(self) -> FleetIndex:
        """Return the list of certificates.

        Raises:
            PkiError: There is no authority in the folder, or its index is damaged.
        """
        return FleetIndex.read(self.folder)

    def issue(
        self,
        platform: str,
        role: Role,
        hosts: Sequence[str] = (),
        days: float = CERTIFICATE_DAYS,
        out: Path | None = None,
    ) -> Bundle:
        """Issue a platform's certificate under a name of its own.

        The first has the platform's name; one after a revocation has the next generation's.

        Raises:
            PkiError: The platform has a certificate that is not revoked (renew or revoke it), or `out` is there.
            BadInputError: A name, a host, the passphrase or the authority's files are wrong.
            OSError: Something cannot be written.
        """
        names.checked_platform(platform, "pki")
        _check_days(days)
        with self._locked():
            index = self.index()
            if (known := index.current(platform)) is not None:
                got = f"a valid certificate, {known.common_name}, serial {known.serial}"
                raise PkiError("pki", platform, got, "none; `pki renew` prolongs it, `pki revoke` ends it")
            name = names.common_name(platform, index.next_generation(platform))
            return self._make(index, name, platform, role, hosts, days, out or self.folder / ISSUED / name)

    def renew(
        self,
        platform: str,
        hosts: Sequence[str] | None = None,
        days: float = CERTIFICATE_DAYS,
        out: Path | None = None,
    ) -> Bundle:
        """Issue a new key and certificate under the platform's present name.

        Routers need no new configuration. The old certificate stays good until it ends: after a loss, revoke instead.

        Raises:
            PkiError: The platform has no certificate to renew, or `out` is there.
            BadInputError: A host, the passphrase or the authority's files are wrong.
            OSError: Something cannot be written.
        """
        _check_days(days)
        with self._locked():
            index = self.index()
            entry = index.current(platform)
            if entry is None:
                raise PkiError("pki", "platform", platform, "a platform with a certificate that is not revoked")
            name = entry.common_name
            made_before = sum(e.common_name == name for e in index.certificates)
            folder = out or self.folder / ISSUED / f"{name}.renewal-{made_before}"
            return self._make(index, name, platform, entry.role, entry.hosts if hosts is None else hosts, days, folder)

    def revoke(self, platform: str, reason: str) -> Issued:
        """Revoke every certificate under a platform's present name, for good.

        It takes effect where a router runs with an access control list made after this.

        Raises:
            PkiError: The platform has no certificate that is not revoked.
            OSError: The index cannot be written.
        """
        with self._locked():
            index = self.index()
            entry = index.current(platform)
            if entry is None:
                raise PkiError("pki", "platform", platform, "a platform with a certificate that is not revoked")
            self._keep(index.with_revoked(entry.common_name, self._now_utc_s(), reason))
            return entry

    def authority_days_left(self) -> float:
        """Return how many days the authority itself is valid.

        Raises:
            PkiError: Its certificate cannot be read.
        """
        authority = x509_files.load_certificate(self._read(CA_CERTIFICATE), str(self.folder / CA_CERTIFICATE))
        return (authority.not_valid_after_utc.timestamp() - self._now_utc_s()) / 86400.0

    def _make(
        self,
        index: FleetIndex,
        name: str,
        platform: str,
        role: Role,
        hosts: Sequence[str],
        days: float,
        folder: Path,
    ) -> Bundle:
        if folder.exists() or folder.is_symlink():
            raise PkiError(str(folder), "", "something there already", "a folder that is not there yet")
        authority = self._authority()
        now_utc_s = self._now_utc_s()
        if authority.certificate.not_valid_after_utc.timestamp() <= now_utc_s:
            end = authority.certificate.not_valid_after_utc.isoformat()
            raise PkiError(str(self.folder / CA_CERTIFICATE), "", f"an authority that ended on {end}", "a valid one")
        signed = x509_files.sign(authority, name, hosts, days, x509_files.utc(now_utc_s))
        entry = Issued(
            serial=signed.serial,
            common_name=name,
            platform=platform,
            role=role,
            hosts=tuple(hosts),
            not_before_utc_s=signed.certificate.not_valid_before_utc.timestamp(),
            not_after_utc_s=signed.certificate.not_valid_after_utc.timestamp(),
        )
        self._keep(index.with_added(entry))
        files = {
            CA_CERTIFICATE: (self._read(CA_CERTIFICATE), PUBLIC_FILE),
            CERTIFICATE: (signed.certificate_pem, PUBLIC_FILE),
            KEY: (signed.key_pem, PRIVATE_FILE),
        }
        try:
            private_files.write_new_folder(folder, files)
        except OSError:
            # Nobody has the key: the entry would only block the next try.
            self._keep(index)
            raise
        return Bundle(entry, folder)

    def _authority(self) -> x509_files.Authority:
        key_pem = self._read(CA_KEY)
        mode = (self.folder / CA_KEY).stat().st_mode & 0o777
        if mode & 0o077:
            raise PkiError(str(self.folder / CA_KEY), "mode", f"{mode:04o}", "0600: nobody else may read this key")
        passphrase = self._passphrase() if x509_files.is_encrypted(key_pem) else None
        return x509_files.load_authority(self._read(CA_CERTIFICATE), key_pem, passphrase, str(self.folder))

    def _read(self, name: str) -> bytes:
        try:
            return (self.folder / name).read_bytes()
        except OSError as error:
            raise PkiError(str(self.folder / name), "", str(error), "a readable file") from error

    def _keep(self, index: FleetIndex) -> None:
        write_atomically(self.folder / INDEX_FILE, index.to_bytes(), PRIVATE_FILE)

    def _locked(self) -> AbstractContextManager[None]:
        if not self.folder.is_dir():
            raise PkiError(str(self.folder), "", "nothing", "an authority: `sonarpost pki init` makes one")
        return private_files.locked(self.folder)


def _check_days(days: float) -> None:
    if not 0 < days <= AUTHORITY_DAYS:
        raise BadInputError("pki", "days", days, f"more than 0 to {AUTHORITY_DAYS}")
