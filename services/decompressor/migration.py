"""Stores of version 0.1: the decompressor received frames then, and its store can hold frames and receiver state."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping

from sonarpost import keys, wire
from sonarpost.delivery.store import Store
from sonarpost.errors import FrameError, PayloadError
from sonarpost.link import migration
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, Direction
from sonarpost.link.downlink.commands import CommandTracker
from sonarpost.link.downlink.vessel_endpoint import VesselEndpoint
from sonarpost.link.received_image import received_image
from sonarpost.link.receiver import ImageUpdate
from sonarpost.link.state import below, prefixed
from sonarpost.logs import kv
from sonarpost.messages import AcousticFrame

log = logging.getLogger(__name__)

_AUTHENTICATION = "authentication/"
_STATES = {
    "receiver": ("paper/", migration.paper_receiver_parts),
    "receiver-v1": ("v1/", migration.v1_receiver_parts),
    "seal": (_AUTHENTICATION, migration.authentication_parts),
}


def migrate_store(store: Store, vessel_id: str, read_key: Callable[[], AcousticKey | None]) -> None:
    """Convert frames and receiver state in a store to received images in its inbox.

    The frames pass through the receivers once. Images of the `paper` format that are still incomplete then are
    converted as they are. The state and the frames are deleted in the same transaction. The vehicle names are in the
    configuration of op_modem only, so the vehicles of these images are named modem-{address}.

    Args:
        store: The store of the decompressor.
        vessel_id: Name of the vessel.
        read_key: Returns the key of the acoustic link; called if there is something to convert.
    """
    items = [item for item in store.inbox_items(2**31) if item.key == keys.acoustic_rx(vessel_id)]
    states = {name: state for name in _STATES if (state := store.get_state(name)) is not None}
    if not items and not states:
        return
    endpoint = _restored(states, read_key())
    images: list[ImageUpdate] = []
    with store.transaction() as tx:
        for item in items:
            try:
                frame = wire.decode(AcousticFrame, item.payload, item.key)
            except PayloadError as error:
                tx.quarantine("in", item.key, item.payload, str(error))
            else:
                images += endpoint.accept(frame.source, frame.data, frame.time_utc_s).images
            tx.remove_handled(item)
        images += endpoint.poll(math.inf)
        for image in images:
            record = received_image(image, vessel_id, f"modem-{image.source}")
            tx.accept(keys.acoustic_image(vessel_id), wire.encode(record))
        for name in states:
            tx.delete_state(name)
    log.info("Store of version 0.1 converted", extra=kv(frames=len(items), images=len(images)))


def _restored(states: Mapping[str, bytes], key: AcousticKey | None) -> VesselEndpoint:
    """Return an endpoint with the saved state; state that cannot be read is logged and skipped."""
    parts: dict[str, bytes] = {}
    errors: dict[str, FrameError] = {}
    for name, state in states.items():
        prefix, convert = _STATES[name]
        try:
            parts |= prefixed(prefix, convert(state))
        except FrameError as error:
            errors[name] = error
    # The authenticator verifies only, so its address is not used.
    authenticator = None if key is None else FrameAuthenticator(key, 0, Direction.TO_VEHICLE)
    endpoint = VesselEndpoint(CommandTracker(60.0), protection=authenticator, wire_formats=("v1", "paper"))
    errors |= endpoint.restore(parts)
    if authenticator is not None:
        errors |= authenticator.restore(below(_AUTHENTICATION, parts))
    for name, reason in errors.items():
        log.error("Discarding an unreadable part of the receiver state", extra=kv(part=name, reason=str(reason)))
    return endpoint
