"""Fixtures of many tests (in-process Zenoh router, platforms in a temporary folder), tiers and order of the suite."""

import logging
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh
from builders.common import REPOSITORY, free_port
from builders.postgresql import database, database_url, postgresql_server
from hypothesis import HealthCheck, settings

from sonarpost.bus.session import client_config, router_config
from sonarpost.config import PlatformConfig

__all__ = ["database", "database_url", "postgresql_server"]

pytest_plugins = ["builders.skips"]

# SIGINT is ignored in a suite started in the background, and child processes would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# The same examples in every run: a result depends on the code alone. Others: --hypothesis-profile random.
# On a loaded machine an example may wait for the disk. pytest-timeout ends a test that hangs.
settings.register_profile(
    "quick",
    deadline=None,
    derandomize=True,
    max_examples=25,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
settings.register_profile("thorough", settings.get_profile("quick"), max_examples=150)
settings.register_profile("random", settings.get_profile("thorough"), derandomize=False)
settings.load_profile("quick")

MEMORY = Path("/dev/shm")
MEMORY_BYTES = 2_000_000_000
if MEMORY.is_dir() and os.access(MEMORY, os.W_OK) and shutil.disk_usage(MEMORY).free > MEMORY_BYTES:
    # The stores of services flush each commit.
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))

SYSTEM_TESTS = ("tests/research/", "tests/system/")
"""Folders of the tests of `make test-system`; other tests of it have the mark `system`, or use PostgreSQL."""
LONG_TESTS = ("tests/system/chain/", "tests/system/faults/", "tests/system/packaging/", "tests/system/docs/")
"""Folders of tests that take longest and mostly wait; they start first."""


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests of `make test-system`, and sort those of `LONG_TESTS` to the front."""
    for item in items:
        quick = item.get_closest_marker("quick") is not None
        fixtures = getattr(item, "fixturenames", ())
        if not quick and (item.nodeid.startswith(SYSTEM_TESTS) or "postgresql_server" in fixtures):
            item.add_marker("system")
        if item.nodeid.startswith("tests/system/compose/"):
            item.add_marker("containers")
    items.sort(key=lambda item: not item.nodeid.startswith(LONG_TESTS))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Do not import the folders of system tests for the quick tests, whose packages are not sufficient for all."""
    quick = config.option.markexpr == "not system"
    folder = f"{collection_path.relative_to(REPOSITORY).as_posix()}/" if collection_path.is_dir() else ""
    is_system = folder.startswith(SYSTEM_TESTS) and folder not in ("tests/system/", "tests/system/chain/")
    return True if quick and is_system else None


@pytest.fixture(autouse=True)
def log_settings() -> Iterator[None]:
    """Restore the handlers and the level of the root logger, which commands run by a test replace."""
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    yield
    root.handlers[:] = handlers
    root.setLevel(level)


@pytest.fixture
def router() -> Iterator[str]:
    """An in-process Zenoh router; the fixture is its endpoint."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    session = zenoh.open(router_config([endpoint]))
    yield endpoint
    session.close()


@pytest.fixture
def client(router: str) -> Iterator[zenoh.Session]:
    """A client of the in-process router, for the test itself."""
    session = zenoh.open(client_config([router]))
    yield session
    session.close()


@pytest.fixture
def platform(router: str, tmp_path: Path) -> Callable[[str], PlatformConfig]:
    """Makes platform configurations that use the in-process router and a temporary state folder."""

    def make(platform_id: str) -> PlatformConfig:
        return PlatformConfig(
            id=platform_id,
            router=(router,),
            state_dir=tmp_path / "state" / platform_id,
            health_interval_s=0.1,
            acoustic_auth="none",
        )

    return make


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """The folder of real surveys and snippets; the test is skipped where it is absent."""
    folder = Path(os.environ.get("SONARPOST_DATA", REPOSITORY.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no real survey data at {folder} (set SONARPOST_DATA)")
    return folder
