"""Contacts from the records that c2 publishes, as they arrive."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from operator import itemgetter
from typing import Final

from sonarpost.export.contacts import ExportContact, ImageSideCar, match_start_time, side_car
from sonarpost.limits import limit, oldest_of_largest
from sonarpost.messages import Decision, ReconstructedImage

MAX_NAMES: Final = limit(
    20_000, "images", "shares", "live contacts", "vessel", "names in memory", "the largest source loses its oldest"
)
MAX_DECISIONS: Final = 256
"""Decisions about one name; further ones are ignored."""
MAX_IMAGES: Final = 64
"""Images of one name, which a vehicle with a new store uses again; the oldest is dropped."""


@dataclass(slots=True)
class _Name:
    images: dict[int, ImageSideCar] = field(default_factory=dict)
    decisions: dict[str, Decision] = field(default_factory=dict)


class LiveContacts:
    """Contacts with their latest image version and all decisions, in bounded memory.

    Args:
        max_names: Limit of image names.
    """

    def __init__(self, max_names: int = MAX_NAMES) -> None:
        self._max_names = max_names
        self._names: OrderedDict[tuple[str, str, str], _Name] = OrderedDict()

    def add(self, record: ReconstructedImage | Decision) -> ExportContact | None:
        """Add a record; return the contact that it changed.

        Returns:
            The contact without `image_path` and `missing_runs`; None for a repeated record, an older version, or a
            decision about an image that has not arrived.
        """
        if isinstance(record, Decision):
            return self._add_decision(record)
        return self._add_image(ImageSideCar.model_validate({**side_car(record), "missing_runs": ""}))

    def located(self, limit: int) -> list[ExportContact]:
        """Return the most recently changed contacts with a position, at most `limit`, the latest last."""
        found: list[ExportContact] = []
        for key in reversed(self._names):
            for start_s in self._names[key].images:
                contact = self._contact(key, start_s)
                if contact.position is not None and len(found) < limit:
                    found.append(contact)
        return found[::-1]

    def _add_image(self, image: ImageSideCar) -> ExportContact | None:
        key, start_s = (image.vessel_id, image.vehicle_id, image.image_id), int(image.first_frame_utc_s)
        name = self._name(key)
        known = name.images.get(start_s)
        if known is not None and known.version >= image.version:
            return None
        name.images[start_s] = image
        if len(name.images) > MAX_IMAGES:
            del name.images[min(name.images)]
        return self._contact(key, start_s) if start_s in name.images else None

    def _add_decision(self, decision: Decision) -> ExportContact | None:
        key = (decision.vessel_id, decision.vehicle_id, decision.image_id)
        name = self._name(key)
        if decision.decision_id in name.decisions or len(name.decisions) >= MAX_DECISIONS:
            return None
        name.decisions[decision.decision_id] = decision
        start_s = match_start_time(tuple(name.images), decision.decided_utc_s)
        return None if start_s is None else self._contact(key, start_s)

    def _name(self, key: tuple[str, str, str]) -> _Name:
        name = self._names.setdefault(key, _Name())
        self._names.move_to_end(key)
        if len(self._names) > self._max_names:
            del self._names[oldest_of_largest(self._names, itemgetter(0))]
        return name

    def _contact(self, key: tuple[str, str, str], start_s: int) -> ExportContact:
        name = self._names[key]
        starts = tuple(name.images)
        decisions = sorted(
            (d for d in name.decisions.values() if match_start_time(starts, d.decided_utc_s) == start_s),
            key=lambda d: (d.decided_utc_s, d.decision_id),
        )
        return ExportContact(name.images[start_s], tuple(decisions), None)
