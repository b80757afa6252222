"""`sonarpost c2 migrate`: copies the archive of c2 from files into PostgreSQL, and compares both.

The command can be interrupted and repeated: what the database has is not copied again. It deletes no file.
"""

import argparse
import os
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import TypeVar

from sonarpost.archive.address import DatabaseAddress
from sonarpost.archive.image_files import SUFFIXES, other_name
from sonarpost.archive.reader import COMMAND_TIMEOUT_S, open_archive, open_reader
from sonarpost.archive.rows import ImageRow
from sonarpost.archive.shore_archive import Batch, ShoreArchive, StoredImage
from sonarpost.archive.shore_files import decision_name
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
        open_reader(folder) as source,
        closing(open_archive(address, site=config.site, timeout_s=COMMAND_TIMEOUT_S)) as database,
    ):
        database.database.prepare()
        migration = Migration(source, database)
        migration.run()
    counts = migration.counts
    print(
        f"{folder} to {address}: images {counts['images']} copied, {counts['images present']} present; decisions"
        f" {counts['decisions']} copied, {counts['decisions present']} present; commands and comments"
        f" {counts['tasking']}; numbers for queries {counts['numbered']}; compared {counts['compared']};"
        f" rejected {len(migration.problems)}"
    )
    return EXIT_INCOMPLETE if print_rejected(migration.problems) else 0


class Migration:
    """Copy of an archive into another one.

    Attributes:
        counts: Numbers of copied, present and compared records, and of those added to the journal.
        problems: Records that are damaged, or of which the database has another content.
    """

    def __init__(self, source: ShoreArchive, database: ShoreArchive) -> None:
        self.counts: Counter[str] = Counter()
        self.problems: list[str] = []
        self._source = source
        self._database = database

    def run(self) -> None:
        """Copy and compare all records."""
        rows = self._source.images(removed=True)
        with ProgressDisplay(step="copying images") as display:
            for number, batch in enumerate(_batches(rows)):
                display.show("copying images", number * BATCH, len(rows))
                self._copy_images(batch)
        self._copy_decisions()
        tasking = self._source.tasking()
        for part in _batches(tasking):
            self._database.write(Batch(tasking=[*part]))
        self.counts["tasking"] = len(tasking)
        self.counts["numbered"] = self._database.adopt_numbers(self._source)

    def _copy_images(self, rows: Sequence[ImageRow]) -> None:
        new: dict[tuple[str, str], StoredImage] = {}
        expected: dict[tuple[str, str], StoredImage] = {}
        for image in self._stored_images(rows):
            placed, is_present = self._place(image)
            own = (placed.row.vessel_id, placed.row.name)
            self.counts["images present" if is_present else "images"] += 1
            if not is_present:
                new[own] = placed
            if not is_present or self._database.find_image(*own) == (placed.row.side_car_sha256, True):
                expected[own] = placed
        if new:
            self._database.write(Batch(images=[*new.values()]))
        for (vessel_id, name), image in expected.items():
            self.counts["compared"] += 1
            if image.files and self._database.file_digests(vessel_id, name) != set(image.row.files_sha256.split()):
                self.problems.append(f"{vessel_id}/{name}: the files in the database differ")

    def _stored_images(self, rows: Sequence[ImageRow]) -> Iterator[StoredImage]:
        """Yield the images whose files have the stored digests; removed ones without files."""
        for row in rows:
            if row.removed_utc_s is not None:
                yield StoredImage(row, ())
                continue
            try:
                files = self._source.read_files(row.vessel_id, row.name)
            except StoredFileError as error:
                self.problems.append(str(error))
                continue
            contents = tuple((suffix, files[suffix]) for suffix in SUFFIXES)
            if " ".join(sha256(data).hexdigest() for _, data in contents) != row.files_sha256:
                self.problems.append(f"{row.vessel_id}/{row.name}: the files differ from their digests")
                continue
            yield StoredImage(replace(row, verified_utc_s=None, fault=""), contents)

    def _place(self, image: StoredImage) -> tuple[StoredImage, bool]:
        """Return an image with the name that it has in the database, and whether it is there."""
        row = image.row
        found = self._database.find_image(row.vessel_id, row.name)
        if found is not None and found[0] != row.side_car_sha256 and image.files:
            row = replace(row, name=other_name(row.name, image.files[0][1]), conflict=True)
            found = self._database.find_image(row.vessel_id, row.name)
        # An image that retention has removed from the database is not restored.
        return StoredImage(row, image.files), found is not None

    def _copy_decisions(self) -> None:
        new = []
        for row in self._source.decisions():
            where, name = f"{row.vessel_id}/{row.decision_id}", decision_name(row.decision_id)
            try:
                content = self._source.read_files(row.vessel_id, name, SUFFIXES[:1])[SUFFIXES[0]]
            except StoredFileError as error:
                self.problems.append(str(error))
                continue
            if sha256(content).hexdigest() != row.files_sha256:
                self.problems.append(f"{where}: the file differs from its digest")
                continue
            found = self._database.find_decision(row.vessel_id, row.decision_id)
            if found is None:
                new.append((replace(row, verified_utc_s=None, fault=""), content))
            elif found != row.files_sha256:
                self.problems.append(f"{where}: the database has another decision with this identifier")
            else:
                self.counts["decisions present"] += 1
        for part in _batches(new):
            self._database.write(Batch(decisions=[*part]))
        for row, _ in new:
            self.counts["compared"] += 1
            if self._database.file_digests(row.vessel_id, decision_name(row.decision_id)) != {row.files_sha256}:
                self.problems.append(f"{row.vessel_id}/{row.decision_id}: the decision in the database differs")
        self.counts["decisions"] = len(new)


def _batches(items: Sequence[T]) -> Iterator[Sequence[T]]:
    for first in range(0, len(items), BATCH):
        yield items[first : first + BATCH]
