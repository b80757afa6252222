"""Fixtures: a store in a temporary folder, services as producers and consumers."""

import pytest
from builders.services import publish, refused, runner

from sonarpost.delivery.store import Store

__all__ = ["publish", "refused", "runner"]


@pytest.fixture
def store(tmp_path):
    opened = Store(tmp_path / "s.db")
    yield opened
    opened.close()
