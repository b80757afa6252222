"""Certificate authority of a fleet, stored in a folder: create, issue, renew, revoke.

    {folder}/             0700
      ca.pem              0644  certificate of the authority, copied to every host
      ca.key              0600  its private key, on this machine only
      index.json          0600  every certificate ever issued
      issued/{name}/      0700  files of one host: ca.pem, certificate.pem, key.pem (0600)

The index is written before a certificate, so that it lists every certificate that exists.
"""

import fcntl
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sonarpost.errors import BadInputError
from sonarpost.files import PRIVATE_FILE, PUBLIC_FILE, write_atomically, write_new_folder
from sonarpost.security import certificates
from sonarpost.security.certificates import SignedCertificate
from sonarpost.wire import first_error

CA_CERTIFICATE = "ca.pem"
CA_KEY = "ca.key"
CERTIFICATE = "certificate.pem"
KEY = "key.pem"
INDEX_FILE = "index.json"
ISSUED = "issued"
AUTHORITY_DAYS = 3650
CERTIFICATE_DAYS = 365.0
MIN_PASSPHRASE_BYTES = 8
DAY_S = 86400.0

Role = Literal["uuv", "vessel", "shore", "console", "observer"]
ROLES: tuple[Role, ...] = ("uuv", "vessel", "shore", "console", "observer")


class PkiError(BadInputError):
    """A request to the authority is invalid."""


class CertificateEntry(BaseModel):
    """Index entry of one certificate.

    Attributes:
        serial: Serial number, hexadecimal.
        common_name: Platform and generation; the name that identifies it at routers.
        platform: The platform.
        role: Role of the platform, which determines its rights at routers.
        hosts: DNS names and addresses of the platform.
        not_before_utc_s: Start of the validity.
        not_after_utc_s: End of the validity.
        revoked_utc_s: When it was revoked; None if it was not.
        reason: Why it was revoked.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    serial: Annotated[str, Field(pattern=r"^[0-9a-f]{1,40}$")]
    common_name: str
    platform: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")]
    role: Role
    hosts: tuple[str, ...]
    not_before_utc_s: float
    not_after_utc_s: float
    revoked_utc_s: float | None = None
    reason: str = ""

    @property
    def not_after(self) -> datetime:
        """End of the validity."""
        return datetime.fromtimestamp(self.not_after_utc_s, UTC)

    def days_left(self, now_utc_s: float) -> float:
        """Return the remaining validity in days, negative after its end."""
        return (self.not_after_utc_s - now_utc_s) / DAY_S


class PreparedName(BaseModel):
    """A platform that routers admit before its certificate is issued.

    Attributes:
        platform: The platform; its first certificate has this common name.
        role: Role that its certificate will have.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    platform: Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9-]{0,31}$")]
    role: Role

    @property
    def common_name(self) -> str:
        """Common name of the first certificate."""
        return certificates.common_name(self.platform, 1)


class FleetIndex(BaseModel):
    """All certificates that the authority has issued, oldest first, and the names that it will issue."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    v: Literal[1] = 1
    fleet: Annotated[str, Field(min_length=1, max_length=64)]
    certificates: tuple[CertificateEntry, ...] = ()
    prepared: tuple[PreparedName, ...] = ()

    @classmethod
    def read(cls, folder: Path) -> "FleetIndex":
        """Read the index of an authority.

        Raises:
            PkiError: It is missing or damaged; names the field.
        """
        path = folder / INDEX_FILE
        try:
            index = cls.model_validate_json(path.read_bytes())
        except FileNotFoundError as error:
            raise PkiError(str(path), "", "nothing", "an authority: `sonarpost pki init` creates one") from error
        except OSError as error:
            raise PkiError(str(path), "", str(error), "a readable file") from error
        except ValidationError as error:
            raise PkiError(str(path), *first_error(error)) from error
        for entry in index.certificates:
            if certificates.platform_of(entry.common_name)[0] != entry.platform:
                raise PkiError(str(path), "common_name", entry.common_name, f"a name of {entry.platform}")
        return index

    def to_bytes(self) -> bytes:
        """Return the content of the file."""
        return (self.model_dump_json(indent=1) + "\n").encode()

    def find(self, platform: str) -> CertificateEntry | None:
        """Return the newest certificate of a platform that is not revoked; it can have expired."""
        entries = [e for e in self.certificates if e.platform == platform and e.revoked_utc_s is None]
        return entries[-1] if entries else None

    def current(self, platform: str) -> CertificateEntry:
        """Return the newest certificate of a platform that is not revoked; it can have expired.

        Raises:
            PkiError: There is none.
        """
        entry = self.find(platform)
        if entry is None:
            raise PkiError("pki", "platform", platform, "a platform with a certificate that is not revoked")
        return entry

    def allowed(self, role: Role) -> Sequence[CertificateEntry | PreparedName]:
        """Return the newest certificate of each common name of a role that is not revoked, and its prepared names."""
        # A prepared name is in use, or revoked, once a certificate has it.
        issued = {e.common_name for e in self.certificates}
        found: dict[str, CertificateEntry | PreparedName] = {
            name.common_name: name for name in self.prepared if name.role == role and name.common_name not in issued
        }
        found |= {e.common_name: e for e in self.certificates if e.revoked_utc_s is None and e.role == role}
        return [found[name] for name in sorted(found)]

    def revoked_names(self) -> Sequence[str]:
        """Return all revoked common names."""
        return sorted({entry.common_name for entry in self.certificates if entry.revoked_utc_s is not None})


@dataclass(frozen=True, slots=True)
class Bundle:
    """A new certificate and the folder with its files."""

    entry: CertificateEntry
    folder: Path


class Fleet:
    """Certificate authority in a folder.

    `passphrase` is called if the key is encrypted.
    """

    def __init__(
        self, folder: Path, passphrase: Callable[[], bytes], now_utc_s: Callable[[], float] = time.time
    ) -> None:
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
    ) -> "Fleet":
        """Create an authority in a new folder.

        Args:
            folder: Must not exist.
            fleet: Name of the fleet.
            passphrase: Encrypts the key; None stores it unencrypted (mode 0600).
            days: Validity of the authority.
            now_utc_s: The clock.

        Raises:
            PkiError: The folder exists, the name is empty or too long, or the passphrase too short.
            OSError: It cannot be written.
        """
        if not 1 <= len(fleet) <= 48 or not fleet.isprintable():
            raise PkiError("pki", "fleet", fleet, "1 to 48 printable characters")
        if passphrase is not None and len(passphrase) < MIN_PASSPHRASE_BYTES:
            got = f"{len(passphrase)} bytes"
            raise PkiError("pki", "passphrase", got, f"at least {MIN_PASSPHRASE_BYTES} bytes")
        authority = certificates.create_authority(fleet, days, now_utc_s())
        files = {
            CA_CERTIFICATE: (authority.certificate_pem(), PUBLIC_FILE),
            CA_KEY: (authority.key_pem(passphrase), PRIVATE_FILE),
            INDEX_FILE: (FleetIndex(fleet=fleet).to_bytes(), PRIVATE_FILE),
        }
        try:
            write_new_folder(folder, files)
        except FileExistsError as error:
            raise _existing(folder) from error
        return cls(folder, lambda: passphrase or b"", now_utc_s)

    def index(self) -> FleetIndex:
        """Return the index of all certificates.

        Raises:
            PkiError: The folder holds no authority, or its index is damaged.
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
        """Issue a certificate under a new common name: the platform, or its next generation after a revocation.

        Raises:
            PkiError: The platform has a certificate that is not revoked (renew or revoke it), is prepared for another
                role, or `out` exists.
            BadInputError: A name, a host, the passphrase or a file of the authority is invalid.
            OSError: A file cannot be written.
        """
        certificates.check_platform(platform)
        with self._locked():
            index = self.index()
            if (known := index.find(platform)) is not None:
                got = f"a valid certificate, {known.common_name}, serial {known.serial}"
                raise PkiError("pki", platform, got, "none; `pki renew` extends it, `pki revoke` ends it")
            used = (entry.common_name for entry in index.certificates if entry.platform == platform)
            generation = 1 + max((certificates.platform_of(name)[1] for name in used), default=0)
            name = certificates.common_name(platform, generation)
            _check_prepared(next((known for known in index.prepared if known.platform == platform), None), role)
            return self._issue(index, name, platform, role, hosts, days, out or self.folder / ISSUED / name)

    def prepare(self, platforms: Sequence[str], role: Role) -> None:
        """Let the routers admit platforms whose certificates will be issued later, without a further restart.

        Raises:
            PkiError: A platform has had a certificate, or is prepared for another role.
            BadInputError: A name is invalid.
            OSError: The index cannot be written.
        """
        with self._locked():
            index = self.index()
            prepared = {name.platform: name for name in index.prepared}
            for platform in platforms:
                certificates.check_platform(platform)
                if any(entry.platform == platform for entry in index.certificates):
                    raise PkiError("pki", platform, "a platform with a certificate", "a new platform")
                _check_prepared(prepared.get(platform), role)
                prepared[platform] = PreparedName(platform=platform, role=role)
            self._write(index.model_copy(update={"prepared": tuple(prepared.values())}))

    def renew(
        self,
        platform: str,
        hosts: Sequence[str] | None = None,
        days: float = CERTIFICATE_DAYS,
        out: Path | None = None,
    ) -> Bundle:
        """Issue a new key and certificate under the platform's present name.

        The configuration of routers does not change. The old certificate remains valid until its end: after a loss,
        revoke it instead.

        Raises:
            PkiError: The platform has no certificate to renew, or `out` exists.
            BadInputError: A host, the passphrase or a file of the authority is invalid.
            OSError: A file cannot be written.
        """
        with self._locked():
            index = self.index()
            entry = index.current(platform)
            name = entry.common_name
            number = sum(e.common_name == name for e in index.certificates)
            folder = out or self.folder / ISSUED / f"{name}.renewal-{number}"
            return self._issue(index, name, platform, entry.role, entry.hosts if hosts is None else hosts, days, folder)

    def revoke(self, platform: str, reason: str) -> CertificateEntry:
        """Revoke all certificates under a platform's present name, permanently.

        It takes effect at each router that is restarted with a new access control list.

        Raises:
            PkiError: The platform has no certificate that is not revoked.
            OSError: The index cannot be written.
        """
        with self._locked():
            index = self.index()
            entry = index.current(platform)
            update = {"revoked_utc_s": self._now_utc_s(), "reason": reason}
            entries = tuple(
                each.model_copy(update=update)
                if each.common_name == entry.common_name and each.revoked_utc_s is None
                else each
                for each in index.certificates
            )
            self._write(index.model_copy(update={"certificates": entries}))
            return entry

    def authority_days_left(self) -> float:
        """Return the remaining validity of the authority in days.

        Raises:
            PkiError: Its certificate cannot be read.
        """
        authority = certificates.load_certificate(self._read(CA_CERTIFICATE), str(self.folder / CA_CERTIFICATE))
        return (authority.not_valid_after_utc.timestamp() - self._now_utc_s()) / DAY_S

    def _issue(
        self,
        index: FleetIndex,
        name: str,
        platform: str,
        role: Role,
        hosts: Sequence[str],
        days: float,
        folder: Path,
    ) -> Bundle:
        if not 0 < days <= AUTHORITY_DAYS:
            raise BadInputError("pki", "days", days, f"more than 0 to {AUTHORITY_DAYS}")
        if folder.exists() or folder.is_symlink():
            raise _existing(folder)
        authority = self._authority()
        signed = certificates.sign(authority, name, hosts, days, self._now_utc_s())
        entry = CertificateEntry(
            serial=f"{signed.certificate.serial_number:x}",
            common_name=name,
            platform=platform,
            role=role,
            hosts=tuple(hosts),
            not_before_utc_s=signed.certificate.not_valid_before_utc.timestamp(),
            not_after_utc_s=signed.certificate.not_valid_after_utc.timestamp(),
        )
        self._write(index.model_copy(update={"certificates": (*index.certificates, entry)}))
        files = {
            CA_CERTIFICATE: (self._read(CA_CERTIFICATE), PUBLIC_FILE),
            CERTIFICATE: (signed.certificate_pem(), PUBLIC_FILE),
            KEY: (signed.key_pem(), PRIVATE_FILE),
        }
        try:
            write_new_folder(folder, files)
        except OSError:
            # The key was not stored: an index entry would only block the next attempt.
            self._write(index)
            raise
        return Bundle(entry, folder)

    def _authority(self) -> SignedCertificate:
        key_pem = self._read(CA_KEY)
        mode = (self.folder / CA_KEY).stat().st_mode & 0o777
        if mode & 0o077:
            raise PkiError(str(self.folder / CA_KEY), "mode", f"{mode:04o}", "0600: readable by its owner only")
        passphrase = self._passphrase() if b"ENCRYPTED" in key_pem else None
        authority = certificates.load_authority(self._read(CA_CERTIFICATE), key_pem, passphrase, str(self.folder))
        end = authority.certificate.not_valid_after_utc
        if end.timestamp() <= self._now_utc_s():
            path = str(self.folder / CA_CERTIFICATE)
            raise PkiError(path, "", f"an authority that ended on {end.isoformat()}", "a valid one")
        return authority

    def _read(self, name: str) -> bytes:
        try:
            return (self.folder / name).read_bytes()
        except OSError as error:
            raise PkiError(str(self.folder / name), "", str(error), "a readable file") from error

    def _write(self, index: FleetIndex) -> None:
        write_atomically(self.folder / INDEX_FILE, index.to_bytes(), PRIVATE_FILE)

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Lock the folder, so that concurrent commands never issue the same name twice."""
        if not self.folder.is_dir():
            raise PkiError(str(self.folder), "", "nothing", "an authority: `sonarpost pki init` creates one")
        descriptor = os.open(self.folder / ".lock", os.O_RDWR | os.O_CREAT, PRIVATE_FILE)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            yield
        finally:
            os.close(descriptor)


def _check_prepared(known: PreparedName | None, role: Role) -> None:
    if known is not None and known.role != role:
        raise PkiError("pki", known.platform, role, f"{known.role}, the role for which it is prepared")


def _existing(folder: Path) -> PkiError:
    return PkiError(str(folder), "", "an existing file or folder", "a folder that does not exist yet")
