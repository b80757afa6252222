"""`sonarpost status` with TLS and access control: an observer sees the shore and the vessels linked to it."""

import json

import pytest
from builders.common import eventually
from builders.fleet import Platforms, health

from sonarpost.cli.main import main

pytestmark = pytest.mark.system


@pytest.fixture
def publishing(vessel_session, shore_session):
    """A service on each side of the radio link publishes its health."""
    platforms = Platforms(vessel_session), Platforms(shore_session)
    platforms[0].run(health("vessel-1", "relay"))
    platforms[1].run(health("shore-1", "c2"))
    yield
    for each in platforms:
        each.close()


@pytest.mark.usefixtures("publishing")
def test_observer_sees_both_sides_of_the_radio_link(world, capsys):
    tls = world.tls("observer-1")
    command = ["status", "--once", "--json", "--router", world.shore_tls]
    command += ["--tls-ca", str(tls.ca), "--tls-certificate", str(tls.certificate), "--tls-key", str(tls.key)]

    def shows_both():
        main(command)
        services = json.loads(capsys.readouterr().out)["services"]
        # The routers publish their health as well.
        return {("vessel-1", "relay", "ok"), ("shore-1", "c2", "ok")} <= {
            (s["platform"], s["service"], s["status"]) for s in services
        }

    eventually(shows_both, what="both sides")
