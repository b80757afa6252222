"""Fixtures: a store in a temporary folder, services as producers and consumers."""

import pytest
from builders.services import publish, refused, runner

from sonarpost.delivery.store import Store

__all__ = ["publish", "refused", "runner"]


@pytest.fixture
def open_store(tmp_path):
    """Opens the store of a file, `s.db` by default, as a start does; one that was opened before is closed first."""
    opened = []

    def open_(path=tmp_path / "s.db", **options):
        while opened:
            opened.pop().close()
        opened.append(Store(path, **options))
        return opened[-1]

    yield open_
    while opened:
        opened.pop().close()


@pytest.fixture
def store(open_store):
    return open_store()
