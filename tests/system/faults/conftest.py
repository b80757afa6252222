"""Coasts for tests: each is closed when its test ends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from builders.coast import Coast, Options


@pytest.fixture
def start_coast(tmp_path: Path) -> Iterator[Callable[..., Coast]]:
    """Starts a vessel and a shore; the arguments are those of `Options`."""
    with ExitStack() as stack:
        yield lambda **options: stack.enter_context(Coast(tmp_path / "coast", Options(**options)))


@pytest.fixture
def coast(start_coast: Callable[..., Coast]) -> Coast:
    """A vessel and a shore as they come."""
    return start_coast()
