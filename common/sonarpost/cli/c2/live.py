"""Live contacts of a shore site, for commands that pass them on to other programs."""

from __future__ import annotations

import argparse
import logging
from dataclasses import dataclass, replace
from pathlib import Path

import zenoh

from sonarpost.cli.c2.watch import RecordSubscription
from sonarpost.cli.shared import add_router_options, add_site_option, option, print_rejected
from sonarpost.export.contacts import ExportContact, load_contacts
from sonarpost.export.live import LiveContacts
from sonarpost.export.source import StoredImages
from sonarpost.logs import kv
from sonarpost.messages import Decision, ReconstructedImage
from sonarpost.review.rendering import eight_bits, encode_png

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class ContactChange:
    """A contact that is new or has changed; `png` is its image if that is new, else None."""

    contact: ExportContact
    png: bytes | None


def add_live_options(parser: argparse.ArgumentParser) -> None:
    """Add --site, --vessel, --archive and the options of the router."""
    add_site_option(parser)
    add_router_options(parser)
    option(parser, "--vessel NAME", "only this vessel")
    option(
        parser,
        "--archive DIR",
        "folder of c2; its contacts are read at the start and after an interruption, so that none is missed",
        Path,
    )


class ContactStream:
    """Contacts of a site: those of c2's folder first, then each change, live.

    After an interrupted connection the folder is read again.

    Args:
        session: Session at the router of the site.
        site: Name of the site.
        vessel: Only contacts of this vessel; None for all.
        archive: Folder of c2; None if it is not on this host.
    """

    def __init__(self, session: zenoh.Session, site: str, vessel: str | None, archive: Path | None) -> None:
        self._watch = RecordSubscription(session, site, vessel)
        self._vessel = vessel
        self._archive = archive
        self._contacts = LiveContacts()
        self._gaps_read = -1

    def poll(self) -> list[ContactChange]:
        """Return the changed contacts; an empty list after 0.2 s without a change.

        Raises:
            StoredFileError: The folder of c2 cannot be read.
        """
        record = self._watch.poll()
        # The folder is read after the subscription exists: a contact between both is in the folder.
        changes = self._read_archive() if self._watch.gaps != self._gaps_read else []
        if isinstance(record, (ReconstructedImage, Decision)):
            try:
                contact = self._contacts.add(record)
                if contact is not None:
                    changes.append(ContactChange(contact, _png_of(record)))
            except Exception:
                log.exception("Record left out", extra=kv(vessel=record.vessel_id, image_id=record.image_id))
        return changes

    def _read_archive(self) -> list[ContactChange]:
        self._gaps_read = self._watch.gaps
        if self._archive is None:
            return []
        stored = load_contacts(self._archive)
        images = StoredImages()
        chosen = (c for c in stored.contacts if self._vessel in (None, c.image.vessel_id))
        changes = [
            ContactChange(replace(contact, image_path=None), images.png(contact))
            for contact in self._contacts.restore(chosen)
        ]
        print_rejected((*stored.problems, *images.problems))
        return changes


def _png_of(record: ReconstructedImage | Decision) -> bytes | None:
    if isinstance(record, Decision) or not record.codec:
        # Without a codec only the contact record was received; its pixels are black.
        return None
    return encode_png(eight_bits(record.pixels.to_array()))
