"""Fixtures: a vessel and a shore site in real processes."""

from contextlib import ExitStack

import pytest
from builders.vessel_and_shore import Options, VesselAndShore


@pytest.fixture
def start_system(tmp_path):
    """Starts a vessel and a shore site; the arguments are those of `Options`."""
    with ExitStack() as stack:
        yield lambda **options: stack.enter_context(VesselAndShore(tmp_path / "system", Options(**options)))


@pytest.fixture
def system(start_system):
    """A vessel and a shore site with default options."""
    return start_system()
