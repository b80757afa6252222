"""Fixture: a small survey."""

from __future__ import annotations

import pytest
from builders import surveys


@pytest.fixture
def small_survey():
    return surveys.small_survey
