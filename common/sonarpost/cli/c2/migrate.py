"""`sonarpost c2 migrate`: copies the archive of c2 from files into PostgreSQL, and compares both.

The command can be interrupted and repeated: what the database has is not copied again. It deletes no file.
"""

from __future__ import annotations

import argparse
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TypeVar

from sonarpost.archive.image_files import SUFFIXES, other_name
from sonarpost.archive.journal import FILE_NAME, Journal
from sonarpost.archive.postgresql import ConnectionPool, DatabaseAddress
from sonarpost.archive.reader import COMMAND_TIMEOUT_S, read_image_files
from sonarpost.archive.shore_database import ShoreDatabase, StoredImage
from sonarpost.archive.shore_files import decision_path, index_missing_files
from sonarpost.archive.shore_index import DecisionRow, ImageRow, ShoreIndex
from sonarpost.cli.c2.stored import EXIT_INCOMPLETE, SHORE_CONFIG
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import option, print_rejected
from sonarpost.config import load
from sonarpost.errors import ConfigError, StoredFileError
from sonarpost.services.c2.config import C2Config

BATCH = 32
"""Number of records that are copied in one transaction."""

T = TypeVar("T")


def add_actions(parser: CommandParser) -> None:
    """Add the action `migrate`."""
    parser = parser.add_action(
        "migrate",
        "copy the archive of c2 from its folder into the PostgreSQL database of the configuration",
        run,
        "--config shore.toml --archive out",
    )
    option(parser, "--config FILE", "TOML file of the shore site, with `database` in [c2]", Path, SHORE_CONFIG)
    option(parser, "--archive DIR", "folder of c2 (default: out_dir of the file)", Path)


def run(parsed: argparse.Namespace) -> int:
    """Copy and compare; return 0, or 1 if a record was rejected or differs.

    Raises:
        ConfigError: The file has no database.
        DatabaseUnavailableError: The server is not reached; the command can be repeated.
    """
    config = load(parsed.config, "c2", C2Config, os.environ)[1]
    address: DatabaseAddress | None = config.database_address()
    if address is None:
        raise ConfigError(str(parsed.config), "c2.database", "nothing", "the address of a PostgreSQL database")
    folder: Path = parsed.archive or config.out_dir
    with (
        closing(ShoreIndex(folder)) as index,
        closing(ShoreDatabase(ConnectionPool(address, COMMAND_TIMEOUT_S), site=config.site)) as database,
    ):
        index_missing_files(folder, index)
        migration = Migration(folder, index, database)
        migration.run()
        if (folder / FILE_NAME).is_file():
            with closing(Journal(folder)) as journal:
                migration.counts["numbered"] = database.adopt_journal(journal)
    counts = migration.counts
    print(
        f"{folder} to {address}: images {counts['images']} copied, {counts['images present']} present; decisions"
        f" {counts['decisions']} copied, {counts['decisions present']} present; commands and comments"
        f" {counts['tasking']}; numbers for queries {counts['numbered']}; compared {counts['compared']};"
        f" rejected {len(migration.problems)}"
    )
    return EXIT_INCOMPLETE if print_rejected(migration.problems) else 0


class Migration:
    """Copy of a folder of c2 into a database.

    Attributes:
        counts: Numbers of copied, present and compared records, and of those added to the journal.
        problems: Records that are damaged, or of which the database has another content.
    """

    def __init__(self, folder: Path, index: ShoreIndex, database: ShoreDatabase) -> None:
        self.counts: Counter[str] = Counter()
        self.problems: list[str] = []
        self._folder = folder
        self._index = index
        self._database = database

    def run(self) -> None:
        """Copy and compare all records."""
        rows = self._index.images(removed=True)
        with ProgressDisplay(step="copying images") as display:
            for number, batch in enumerate(_batches(rows)):
                display.show("copying images", number * BATCH, len(rows))
                self._copy_images(batch)
        self._copy_decisions()
        tasking = self._index.tasking()
        for part in _batches(tasking):
            self._database.put_tasking(part)
        self.counts["tasking"] = len(tasking)

    def _copy_images(self, rows: Sequence[ImageRow]) -> None:
        new: dict[tuple[str, str], StoredImage] = {}
        expected: dict[tuple[str, str], dict[str, str]] = {}
        for image in self._stored_images(rows):
            placed, is_present = self._place(image)
            key = (placed.row.vessel_id, placed.row.name)
            self.counts["images present" if is_present else "images"] += 1
            if not is_present:
                new[key] = placed
            if not is_present or self._database.find_side_car(*key) == (_digest(placed), True):
                expected[key] = {suffix: sha256(data).hexdigest() for suffix, data in placed.files}
        if new:
            self._database.write([*new.values()])
        found = self._database.file_digests([replace(rows[0], vessel_id=v, name=n) for v, n in expected])
        for key, digests in expected.items():
            self.counts["compared"] += 1
            if digests != found.get(key, {}):
                self.problems.append(f"{'/'.join(key)}: the files in the database differ")

    def _stored_images(self, rows: Sequence[ImageRow]) -> Iterator[StoredImage]:
        """Yield the images whose files are as the index states; removed ones without files."""
        for row in rows:
            if row.removed_utc_s is not None:
                yield StoredImage(row, ())
                continue
            try:
                files = read_image_files(self._folder, row)
            except StoredFileError as error:
                self.problems.append(str(error))
                continue
            contents = tuple((suffix, files[f"{row.name}{suffix}"]) for suffix in SUFFIXES)
            digests = " ".join(sha256(data).hexdigest() for _, data in contents)
            if digests != row.files_sha256:
                self.problems.append(f"{row.vessel_id}/{row.name}: the files differ from the index")
                continue
            yield StoredImage(replace(row, verified_utc_s=None, fault=""), contents)

    def _place(self, image: StoredImage) -> tuple[StoredImage, bool]:
        """Return an image with the name that it has in the database, and whether it is there."""
        row = image.row
        found = self._database.find_side_car(row.vessel_id, row.name)
        if found is not None and found[0] != _digest(image) and image.files:
            row = replace(row, name=other_name(row.name, image.files[0][1]), conflict=True)
            found = self._database.find_side_car(row.vessel_id, row.name)
        # An image that retention has removed from the database is not restored.
        return StoredImage(row, image.files), found is not None

    def _copy_decisions(self) -> None:
        new: list[tuple[DecisionRow, bytes]] = []
        for row in self._index.decisions():
            path = decision_path(self._folder, row.vessel_id, row.decision_id)
            try:
                content = path.read_bytes()
            except OSError as error:
                self.problems.append(f"{path}: {error.strerror or error}")
                continue
            digest = sha256(content).hexdigest()
            if digest != row.files_sha256:
                self.problems.append(f"{path}: the file differs from the index")
                continue
            found = self._database.find_decision(row.vessel_id, row.decision_id)
            if found is None:
                new.append((replace(row, verified_utc_s=None, fault=""), content))
            elif found != digest:
                self.problems.append(f"{path}: the database has another decision with this identifier")
            else:
                self.counts["decisions present"] += 1
        for part in _batches(new):
            self._database.write([], part)
        for row, content in new:
            self.counts["compared"] += 1
            if self._database.decision_content(row) != content:
                self.problems.append(f"{row.vessel_id}/{row.decision_id}: the decision in the database differs")
        self.counts["decisions"] = len(new)


def _digest(image: StoredImage) -> str:
    return image.row.files_sha256.partition(" ")[0]


def _batches(items: Sequence[T]) -> Iterator[Sequence[T]]:
    for first in range(0, len(items), BATCH):
        yield items[first : first + BATCH]
