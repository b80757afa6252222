"""Bearers of upstreams other than the radio. The group of entry points is `sonarpost.upstreams`."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar

from sonarpost.config import ServiceConfig, adds_keys
from sonarpost.messages import CodedImage, Decision
from sonarpost.registry import Registry
from sonarpost.runtime.service import Service, UnitOfWork

if TYPE_CHECKING:
    from sonarpost.services.relay.config import UpstreamOptions


class Bearer(ABC):
    """Carries copies of the records of the vessel to one site.

    Args:
        options: The upstream in the configuration.
        service: The relay.
        has_radio: Whether the site also has a radio upstream.

    Attributes:
        KEYS: Keys that it adds to `[[relay.upstreams]]`.
        site: Name of the site.
    """

    KEYS: ClassVar[type[ServiceConfig]]
    site: str

    @abstractmethod
    def __init__(self, options: UpstreamOptions, service: Service[Any], *, has_radio: bool) -> None: ...

    @abstractmethod
    def queue(self, record: CodedImage | Decision, effects: UnitOfWork) -> None:
        """Queue a record with the other effects of its handling; `committed` has to follow."""

    @abstractmethod
    def committed(self) -> None:
        """Send what has been committed."""

    @abstractmethod
    def delivered_by_radio(self, fields: Mapping[str, object]) -> None:
        """Withdraw a decision, a decoded image or a part of an image, by its fields: the radio has delivered it."""

    @abstractmethod
    def run(self, stopping: threading.Event) -> None:
        """Send until `stopping` is set."""

    @abstractmethod
    def stop(self) -> None:
        """End `run`; `stopping` is set."""

    @abstractmethod
    def warning(self) -> str:
        """Return what prevents sending."""

    @abstractmethod
    def gauges(self) -> Mapping[str, float]:
        """Return the gauges for health."""


@cache
def bearers() -> Registry[type[Bearer]]:
    """Return the bearers by the value of `bearer` in the configuration."""
    expected = "a class of Bearer with KEYS, not radio"
    return Registry(
        "sonarpost.upstreams", expected, lambda found, name: adds_keys(found, Bearer) and name != "radio", {}
    )
