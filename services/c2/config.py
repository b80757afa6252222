"""Configuration of c2: the `[c2]` table."""

from pathlib import Path
from typing import Annotated

from pydantic import Field
from typing_extensions import override

from sonarpost.archive.address import DatabaseAddress
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.config import PlatformConfig, with_keys
from sonarpost.keys import SHORE
from sonarpost.messages import PlatformId
from sonarpost.runtime.retention import MaxBytes, RetentionConfig
from sonarpost.services.c2.inputs import inputs


@with_keys(*(each.KEYS for each in inputs().working().values()))
class C2Config(RetentionConfig):
    """The `[c2]` table.

    Attributes:
        site: Name of this site in keys; relays name it in their upstreams.
        out_dir: Folder of the stored records, with a folder for each vessel and a database.
        max_bytes: Maximum size of the stored images; above it the vessel with the most bytes loses images: exported
            ones first, then those without a decision, then the others, each the oldest first. Decisions are never
            removed. Each of the three files of an image counts at least 16 KiB.
        codebooks: Tile codebooks that vehicles may use: nominal-10, nominal-20 or files. c2 requests others from the
            vessel and keeps them in the folder `codebooks` of state_dir.
        decode_workers: Processes that decode images, each with up to 250 MB of memory.
        database: PostgreSQL database of the records, `postgresql://USER@HOST/DATABASE`, which several c2 can share;
            without one they are in `out_dir`. The connection uses TLS, unless the server is on this host or the address
            ends in `?sslmode=disable`; `sslrootcert=FILE` names the authority.
        database_password_file: File with the password, in place of one in the address.
        verify_days: Time in which every stored file is compared with its digest once; 0 disables the comparison.
        json_mirror: Whether c2 also publishes every record as JSON below `{site}/json`, for clients without msgpack.
    """

    site: PlatformId = SHORE
    out_dir: Path = Path("out")
    max_bytes: MaxBytes = 50_000_000_000
    codebooks: Annotated[tuple[str, ...], Field(min_length=1)] = ("nominal-10", "nominal-20")
    decode_workers: Annotated[int, Field(ge=1, le=64)] = 1
    database: str | None = None
    database_password_file: Path | None = None
    verify_days: Annotated[float, Field(ge=0, le=36500)] = 1.0
    json_mirror: bool = False

    @override
    def check_with(self, platform: PlatformConfig) -> None:
        """Check that the codebooks can be read, and the address of the database.

        Raises:
            CodebookError: A codebook cannot be read.
            ConfigError: The address of the database is invalid, or its password cannot be read.
        """
        self.database_address()
        for name in self.codebooks:
            open_codebook(name)

    def database_address(self) -> DatabaseAddress | None:
        """Return the address of the database; None for an archive of files.

        Raises:
            ConfigError: It is invalid, or its password cannot be read.
        """
        if self.database is None:
            return None
        return DatabaseAddress.parse(self.database, self.database_password_file, "c2")
