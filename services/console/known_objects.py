"""The calibrated watch, which adds sealed contacts with known objects to the queue: an extension has it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Protocol

from sonarpost.messages import ReconstructedImage
from sonarpost.registry import Registry


class Watch(Protocol):
    """Adds sealed contacts to the queue of a console. Created with the state of the console and their share."""

    def start(self) -> None:
        """Start to add contacts and to answer their requests."""

    def stop(self) -> None:
        """Stop."""

    def contact_arrived(self, image: ReconstructedImage, now_s: float) -> None:
        """Note a new contact of a vehicle; `now_s` is monotonic."""


@cache
def watches() -> Registry[Callable[..., Watch]]:
    """Return the kinds of watch: see `sonarpost.registry`. The group of entry points is `sonarpost.watches`."""
    return Registry("sonarpost.watches", "a class of watches", lambda found, _: callable(found), {})
