"""Fixture: a small survey."""

import pytest
from builders import surveys


@pytest.fixture
def small_survey():
    return surveys.small_survey
