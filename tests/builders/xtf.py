"""XTF files, with the writer of the extension simulation; a test that writes one is skipped without the extension."""

from typing import Any

import pytest


def write_xtf(*arguments: Any, **options: Any) -> None:
    """Write a survey; see `sonarpost.extensions.simulation.seabed.xtf_writer.write_xtf`."""
    writer = pytest.importorskip("sonarpost.extensions.simulation.seabed.xtf_writer")
    writer.write_xtf(*arguments, **options)
