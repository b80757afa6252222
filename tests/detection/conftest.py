"""Fixtures of these tests: surveys of speckle, the detection of one object, and fewer candidates."""

from contextlib import contextmanager

import pytest
from builders.speckle_survey import make_survey

from sonarpost.detection import candidates
from sonarpost.detection.detector import detect

__all__ = ["make_survey"]


@contextmanager
def fewer_candidates():
    """Classify the 20 best places of a side instead of 400: the same objects are found in a third of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(candidates, "_MAX_PER_1000_PINGS", 20)
        yield


@pytest.fixture(scope="session")
def one_object(make_survey):
    """A survey of one object to port, and its detection."""
    survey = make_survey({})
    with fewer_candidates():
        (found,) = detect(survey)
    return survey, found


@pytest.fixture(scope="module")
def few_candidates():
    with fewer_candidates():
        yield
