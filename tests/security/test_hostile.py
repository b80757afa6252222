"""One vessel, file, user or client harms only itself: the table of attacks, with what other sources measure."""

import os
import time

import pytest
from builders.hostile_rows import rows
from builders.hostile_site import running_site

pytestmark = pytest.mark.system

ATTACK_S = 4.0
WORKERS = int(os.environ.get("SONARPOST_HOSTILE_WORKERS", "1"))
ATTACKS = [row for row in rows() if callable(row.function)]


@pytest.fixture(scope="module")
def site(tmp_path_factory, shared_world):
    with running_site(tmp_path_factory.mktemp("site"), shared_world, WORKERS) as site:
        for row in {row.measured: row for row in ATTACKS}.values():
            print(f"{row.measured}: {max(row.delays_s(site)):.1f} s without an attack")
        yield site


@pytest.mark.parametrize("row", ATTACKS, ids=lambda row: row.name)
def test_other_sources_are_served(site, row):
    with row.function(site):
        delays_s, begin_s = [], time.monotonic()
        # Some attacks need a time until they have an effect.
        while time.monotonic() < begin_s + ATTACK_S:
            delays_s += row.delays_s(site)
    print(
        f"{row.source}, {row.attack}: {len(delays_s)} of {len(delays_s)}, at most {max(delays_s):.1f} s; {site.check()}"
    )
