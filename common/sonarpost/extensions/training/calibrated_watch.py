"""Calibrated watch: sealed contacts with known objects among those of the vehicles, to measure Pd and false alarms.

A sealed contact looks like one of a vehicle until an operator has decided. Then the page marks it, and lists omit it.
Its decisions and requests are never sent: the watch answers the requests itself.
"""

import heapq
import logging
import random
import sqlite3
import threading
import time
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from sonarpost.errors import SonarpostError
from sonarpost.export.contacts import contact_uid
from sonarpost.extensions.training import sealed_images
from sonarpost.link.frames.paper.frame import format_image_id
from sonarpost.logs import kv
from sonarpost.messages import Contact, ReconstructedImage
from sonarpost.review.objects import Look, looks_within_gate
from sonarpost.review.positions import destination, vehicle_position
from sonarpost.services.console.state import ConsoleState
from sonarpost.services.console.store.association import looks_near
from sonarpost.services.console.store.contacts import find_contact
from sonarpost.services.console.store.requests import update_request_state
from sonarpost.services.console.store.truth import Truth
from sonarpost.sonar.survey import Side

log = logging.getLogger(__name__)

DELAY_S: Final = (20.0, 180.0)
"""Shortest and longest time between a contact of a vehicle and the sealed contact that imitates it."""
DISTANCE_M: Final = (40.0, 150.0)
"""Shortest and longest distance between both, so that they do not form one object."""
POSITION_DRAWS: Final = 10
MAX_WAITING: Final = 50
IMAGE_ID_STEPS: Final = (5, 400)
STEP_S: Final = 1.0
ACCEPTED_S: Final = 2.0
"""Time until a request is shown as sent."""
UNANSWERED_AIRTIME_S: Final = 30.0
"""Time until the answer to a request whose cost is unknown."""

_OPEN_REQUESTS: Final = (
    "SELECT r.* FROM request r JOIN truth t ON t.contact_id = r.contact_id"
    " WHERE t.sealed = 1 AND r.state IN ('waiting', 'asked', 'sent') ORDER BY r.seq"
)
"""SQL: the requests for sealed contacts that have no answer."""


class CalibratedWatch:
    """Adds sealed contacts to the queue of a vessel's console.

    Args:
        state: State of the console.
        share: Sealed contacts for each contact of a vehicle, 0 to 1.
        draws: Random draws; by default from the operating system, so that they cannot be predicted.
        count: Called for each added contact.
    """

    def __init__(
        self,
        state: ConsoleState,
        share: float,
        draws: random.Random | None = None,
        count: Callable[[], object] = lambda: None,
    ) -> None:
        self._state = state
        self._share = share
        self._draws = random.SystemRandom() if draws is None else draws
        self._count = count
        self._lock = threading.Lock()
        self._waiting: list[tuple[float, int, ReconstructedImage]] = []
        self._number = 0
        self._snippets: dict[str, npt.NDArray[np.uint8]] = {}
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="calibrated-watch", daemon=True)

    def start(self) -> None:
        """Start the thread that adds contacts and answers requests."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=5.0)

    def contact_arrived(self, image: ReconstructedImage, now_s: float) -> None:
        """Choose by chance whether a sealed contact imitates a new contact of a vehicle; `now_s` is monotonic."""
        if self._draws.random() >= self._share or not sealed_images.can_imitate(image):
            return
        with self._lock:
            if len(self._waiting) < MAX_WAITING:
                self._number += 1
                heapq.heappush(self._waiting, (now_s + self._draws.uniform(*DELAY_S), self._number, image))

    def _run(self) -> None:
        while not self._stop.wait(STEP_S):
            try:
                self.step(time.monotonic())
            except Exception as error:
                is_defect = not isinstance(error, SonarpostError)
                log.error("Sealed contact not added", exc_info=is_defect, extra=kv(reason=str(error)))

    def step(self, now_s: float) -> None:
        """Add the sealed contacts that are due, and answer requests; `now_s` is monotonic."""
        while True:
            with self._lock:
                if not self._waiting or self._waiting[0][0] > now_s:
                    break
                _, _, reference = heapq.heappop(self._waiting)
            self._add(reference)
        with self._state.database.read() as db:
            requests = db.execute(_OPEN_REQUESTS).fetchall()
        for request in requests:
            self._answer(request)
        self._state.reveal()

    def _add(self, reference: ReconstructedImage) -> None:
        # The images of a survey have the pixel size of their reference, which may change between vehicles.
        known = next(sealed_images.known_objects(reference, self._draws), None)
        contact = reference.contact
        if known is None or contact is None:
            log.info("No sealed contact: the detector finds no object in the simulated survey")
            return
        position = self._position(contact, known)
        if position is None:
            log.info("No sealed contact: there are other contacts at the place")
            return
        image_id = format_image_id(int(reference.image_id, 36) + self._draws.randint(*IMAGE_ID_STEPS))
        record = sealed_images.sealed_record(known, reference, image_id, position, self._state.clock())
        truth = Truth(known.target.is_mine_like, known.target.kind.value.replace("_", " "), sealed=True)
        if self._state.store_image(record, truth):
            self._snippets[contact_uid(record)] = known.snippet
            self._count()

    def _position(self, contact: Contact, known: sealed_images.KnownObject) -> tuple[float, float] | None:
        """Return a position at which there is no look; None without one. A sealed contact is no look at its object."""
        rule = self._state.rule
        for _ in range(POSITION_DRAWS):
            position = self._draw_position(contact, known)
            look = Look("", *position, contact.position_sigma_m)
            with self._state.database.read() as db:
                near = looks_near(db, look, rule.search_m)
            if not looks_within_gate(look, near, rule):
                return position
        return None

    def _draw_position(self, contact: Contact, known: sealed_images.KnownObject) -> tuple[float, float]:
        """Return a position on the line of the vehicle, some distance before or after a contact."""
        along_m = self._draws.choice((-1, 1)) * self._draws.uniform(*DISTANCE_M)
        lat, lon = contact.lat_deg, contact.lon_deg
        assert lat is not None
        assert lon is not None
        heading_deg = contact.heading_deg
        vehicle = vehicle_position(lat, lon, heading_deg, contact.channel, contact.ground_range_m)
        if vehicle is None or heading_deg is None:
            return destination(lat, lon, self._draws.uniform(0.0, 360.0), abs(along_m))
        lat, lon = destination(*vehicle, heading_deg, along_m)
        bearing_deg = heading_deg + (90.0 if known.detection.side is Side.STARBOARD else -90.0)
        return destination(lat, lon, bearing_deg, known.detection.ground_range_m or 0.0)

    def _answer(self, request: sqlite3.Row) -> None:
        """Advance a request as vehicle and link would."""
        contact_id, now_utc_s = str(request["contact_id"]), self._state.clock()
        age_s = now_utc_s - request["asked_utc_s"]
        limit_s = UNANSWERED_AIRTIME_S if request["airtime_s"] is None else request["airtime_s"]
        if age_s < ACCEPTED_S:
            return
        with self._state.database.transaction() as db:
            update_request_state(
                db, request["command_id"], "sent" if age_s < limit_s else "confirmed", "", 1, now_utc_s
            )
            version = find_contact(db, contact_id)["version"]
        snippet = self._snippets.get(contact_id)
        if age_s < limit_s or request["kind"] != "refine" or snippet is None:
            return
        newest = self._state.image(contact_id, version)
        total = 2 * newest.bytes_total
        refined = sealed_images.next_version(newest, snippet, newest.version + 1, total, total, now_utc_s)
        self._state.store_image(refined)
