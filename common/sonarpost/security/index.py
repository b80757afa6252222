"""The list of every certificate that a fleet's authority has issued: `index.json` in the authority's folder."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sonarpost.errors import BadInputError
from sonarpost.security import names

Role = Literal["uuv", "vessel", "shore", "console", "observer"]
ROLES: tuple[Role, ...] = ("uuv", "vessel", "shore", "console", "observer")
INDEX_FILE = "index.json"


class PkiError(BadInputError):
    """A fleet's authority cannot do what it was asked."""


class Issued(BaseModel):
    """One certificate.

    Attributes:
        serial: Its serial number, hexadecimal.
        common_name: Platform and generation; the name that routers know it by.
        platform: The platform alone.
        role: What the platform is, and so what routers let it do.
        hosts: Names and addresses it may be reached under.
        not_before_utc_s: Begin of its validity.
        not_after_utc_s: End of its validity.
        revoked_utc_s: When it was revoked, None while it is not.
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
        """End of its validity."""
        return datetime.fromtimestamp(self.not_after_utc_s, UTC)

    def days_left(self, now_utc_s: float) -> float:
        """Return how many days it is still valid, negative when it has expired."""
        return (self.not_after_utc_s - now_utc_s) / 86400.0


class FleetIndex(BaseModel):
    """Everything the authority has issued, oldest first."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    v: Literal[1] = 1
    fleet: Annotated[str, Field(min_length=1, max_length=64)]
    certificates: tuple[Issued, ...] = ()

    @classmethod
    def read(cls, folder: Path) -> FleetIndex:
        """Read the index of an authority's folder.

        Raises:
            PkiError: There is none, or it is damaged; names the field.
        """
        path = folder / INDEX_FILE
        try:
            index = cls.model_validate_json(path.read_bytes())
        except FileNotFoundError as error:
            raise PkiError(str(path), "", "nothing", "an authority: `sonarpost pki init` makes one") from error
        except OSError as error:
            raise PkiError(str(path), "", str(error), "a readable file") from error
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            field = ".".join(str(part) for part in first["loc"])
            raise PkiError(str(path), field, first.get("input"), first["msg"]) from error
        for entry in index.certificates:
            if names.platform_of(entry.common_name)[0] != entry.platform:
                raise PkiError(str(path), "common_name", entry.common_name, f"a name of {entry.platform}")
        return index

    def to_bytes(self) -> bytes:
        """Return the file's content."""
        return (self.model_dump_json(indent=1) + "\n").encode()

    def of_platform(self, platform: str) -> Sequence[Issued]:
        """Return every certificate of a platform, oldest first."""
        return [entry for entry in self.certificates if entry.platform == platform]

    def current(self, platform: str) -> Issued | None:
        """Return the newest certificate of a platform that is not revoked; it may have expired."""
        found = [entry for entry in self.of_platform(platform) if entry.revoked_utc_s is None]
        return found[-1] if found else None

    def allowed(self, role: Role) -> Sequence[Issued]:
        """Return the newest certificate of every common name of a role that routers shall let in."""
        newest = {e.common_name: e for e in self.certificates if e.revoked_utc_s is None and e.role == role}
        return sorted(newest.values(), key=lambda e: e.common_name)

    def revoked_names(self) -> Sequence[str]:
        """Return every common name that has been revoked."""
        return sorted({entry.common_name for entry in self.certificates if entry.revoked_utc_s is not None})

    def next_generation(self, platform: str) -> int:
        """Return the generation of the next certificate with a name of its own; a revoked name never comes back."""
        return 1 + max((names.platform_of(e.common_name)[1] for e in self.of_platform(platform)), default=0)

    def with_added(self, entry: Issued) -> FleetIndex:
        """Return the index with one more certificate."""
        return self.model_copy(update={"certificates": (*self.certificates, entry)})

    def with_revoked(self, name: str, now_utc_s: float, reason: str) -> FleetIndex:
        """Return the index with every certificate of a common name revoked."""
        mark = {"revoked_utc_s": now_utc_s, "reason": reason}
        entries = tuple(
            entry.model_copy(update=mark) if entry.common_name == name and entry.revoked_utc_s is None else entry
            for entry in self.certificates
        )
        return self.model_copy(update={"certificates": entries})
