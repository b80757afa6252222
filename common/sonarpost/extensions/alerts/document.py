"""Alerts about contacts: which contacts cause one, their JSON document, and its signature."""

import hashlib
import hmac
import json
from typing import Final

from sonarpost.export.contacts import ExportContact
from sonarpost.export.tables import contact_properties
from sonarpost.export.text import xml_text

TYPE: Final = "sonarpost.alert"
VERSION: Final = 1
MAX_CONFIDENCE: Final = 2.0
"""Highest confidence of the detector."""


def score(contact: ExportContact) -> float | None:
    """Return how much a contact resembles a mine, 0 to 1; None if it is not known.

    It is the probability of a mine-like object. A contact without probabilities has half the confidence of the
    detector, which is 0 to 2 and not a probability.
    """
    record = contact.image.contact
    if record is None:
        return None
    if record.p_mine_like is not None:
        return record.p_mine_like
    return None if record.atd_confidence is None else record.atd_confidence / MAX_CONFIDENCE


def needs_alert(contact: ExportContact, threshold: float) -> bool:
    """Return whether a contact causes an alert.

    An operator's verdict counts more than the detector: a mine-like or disputed contact causes one, a contact that is
    not mine-like causes none.

    Args:
        contact: The contact.
        threshold: Smallest score of a contact without a verdict, 0 to 1.
    """
    if contact.review in ("mine_like", "disputed"):
        return True
    value = score(contact)
    return contact.review != "not_mine_like" and value is not None and value >= threshold


def alert_document(contact: ExportContact, sent_utc: str) -> bytes:
    """Return the alert as JSON: `type`, `v`, `id`, `sent_utc`, `score`, and the known properties of the contact.

    Args:
        contact: The contact.
        sent_utc: Time of the first attempt to send it, ISO 8601.
    """
    known = {
        name: xml_text(value) if isinstance(value, str) else value
        for name, value in contact_properties(contact).items()
        if value is not None and name != "image_file"
    }
    head = {"type": TYPE, "v": VERSION, "id": contact.uid, "sent_utc": sent_utc, "score": score(contact)}
    return json.dumps({**head, "contact": known}, ensure_ascii=False, allow_nan=False).encode()


def signature(key: bytes, timestamp: str, body: bytes) -> str:
    """Return the value of the header `X-Sonarpost-Signature`: HMAC-SHA256 of timestamp, a dot and the body."""
    return "sha256=" + hmac.new(key, timestamp.encode() + b"." + body, hashlib.sha256).hexdigest()
