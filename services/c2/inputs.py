"""Ways into c2 other than the relays of the vessels. The group of entry points is `sonarpost.inputs`."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable
from functools import cache
from typing import TYPE_CHECKING, Any, ClassVar, Self

from sonarpost.config import ServiceConfig, adds_keys
from sonarpost.registry import Registry
from sonarpost.runtime.service import Service

if TYPE_CHECKING:
    from sonarpost.services.c2.config import C2Config


class Input(ABC):
    """Accepts records in its own way, and commits them to the inbox of c2.

    Attributes:
        KEYS: Keys that it adds to `[c2]`.
    """

    KEYS: ClassVar[type[ServiceConfig]]

    @classmethod
    @abstractmethod
    def configured(cls, config: C2Config) -> Self | None:
        """Return the input of a configuration, None if it has none.

        Raises:
            ConfigError: A file that the configuration names is invalid.
        """

    @abstractmethod
    def open(self, service: Service[Any]) -> None:
        """Begin to accept records for c2."""

    @abstractmethod
    def run(self, stopping: threading.Event) -> None:
        """Work until `stopping` is set."""

    @abstractmethod
    def close(self) -> None:
        """Accept no more records."""

    @abstractmethod
    def faults(self) -> Iterable[str]:
        """Return what does not work at present."""


@cache
def inputs() -> Registry[type[Input]]:
    """Return all inputs."""
    return Registry("sonarpost.inputs", "a class of Input with KEYS", lambda found, _: adds_keys(found, Input), {})
