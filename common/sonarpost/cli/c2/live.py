"""Live contacts of a shore site, for commands that pass them on to other programs."""

import argparse
import logging
from dataclasses import dataclass

import zenoh

from sonarpost import keys
from sonarpost.bus.catch_up import CatchUpSubscriber
from sonarpost.cli.c2.watch import POLL_S, ConnectionLog, decoded
from sonarpost.cli.shared import add_router_options, add_site_option, flag, option
from sonarpost.export.contacts import ExportContact
from sonarpost.export.live import LiveContacts
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
    """Add --site, --vessel, --stored and the options of the router."""
    add_site_option(parser)
    add_router_options(parser)
    option(parser, "--vessel NAME", "only this vessel")
    flag(parser, "--stored", "begin with the contacts that c2 has stored, not with the next one")


class ContactStream:
    """Contacts of a site as c2 accepts them; an interrupted connection loses none.

    Args:
        session: Session at the router of the site.
        site: Name of the site.
        vessel: Only contacts of this vessel; None for all.
        stored: Whether to begin with the stored contacts, not with the next one.
    """

    def __init__(self, session: zenoh.Session, site: str, vessel: str | None, *, stored: bool) -> None:
        self._connection = ConnectionLog(session)
        self._records = CatchUpSubscriber(session, keys.shore_contact_all(site), only_new=not stored)
        self._vessel = vessel
        self._contacts = LiveContacts()

    def poll(self) -> list[ContactChange]:
        """Return the contact that has changed; an empty list after 0.2 s without a change.

        Raises:
            QueryRefusedError: c2 refuses the query.
        """
        self._connection.check()
        found = self._records.poll(POLL_S)
        record = None if found is None else decoded(found, self._vessel)
        if isinstance(record, (ReconstructedImage, Decision)):
            try:
                contact = self._contacts.add(record)
                return [] if contact is None else [ContactChange(contact, _png_of(record))]
            except Exception:
                log.exception("Record left out", extra=kv(vessel=record.vessel_id, image_id=record.image_id))
        return []


def _png_of(record: ReconstructedImage | Decision) -> bytes | None:
    if isinstance(record, Decision) or not record.codec:
        # Without a codec only the contact record was received; its pixels are black.
        return None
    return encode_png(eight_bits(record.pixels.to_array()))
