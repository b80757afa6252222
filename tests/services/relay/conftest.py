"""Fixtures of the tests of the relay: the relay, c2 of each site, a source of records."""

import pytest

from sonarpost import keys
from sonarpost.messages import ImagePart, Relayed
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService


@pytest.fixture
def begin(runner, platform):
    """Starts the relay for these upstreams, by default one."""

    def start(*upstreams, **options):
        config = RelayConfig(**({"upstreams": upstreams} if upstreams else {}), **options)
        return runner.start(RelayService(platform("vessel-1"), config))

    return start


@pytest.fixture
def c2(runner):
    """Starts the consumer of a site."""

    def start(site="shore", platform_id="shore-1"):
        return runner.peer(
            platform_id, "c2", {keys.shore_inbox_all(site): Relayed, keys.shore_part_all(site): ImagePart}
        )

    return start


@pytest.fixture
def source(runner):
    return runner.peer("vessel-1", "decompressor")
