"""Rights at a vessel's router: a compromised shore can send comments and commands only; consoles."""

import time

import pytest
from builders.common import eventually
from builders.fleet_certificates import tls_of

from sonarpost import keys
from sonarpost.security.fleet import Fleet
from sonarpost.security.tls_files import check_tls_files

VESSEL = "vessel-1"
DECISION = keys.delivery_query(keys.contact_decision(VESSEL), "relay")
COMMENT = keys.delivery_query(keys.comment(VESSEL), "relay")
COMMAND = keys.delivery_query(keys.command(VESSEL, "resend"), "relay")
IMAGE = keys.delivery_query(keys.image_reconstructed(VESSEL), "relay")


@pytest.fixture
def relay(vessel_session):
    """Keys of the delivery queries and publications that reach the vessel's relay."""
    asked: list[str] = []

    def answer(query):
        with query:
            asked.append(str(query.key_expr))
            query.reply(query.key_expr, b"stored")

    for key in (
        keys.contact_decision(VESSEL),
        keys.comment(VESSEL),
        keys.command_all(VESSEL),
        keys.image_reconstructed(VESSEL),
    ):
        vessel_session.declare_queryable(keys.delivery_query(key, "relay"), answer)
    vessel_session.declare_subscriber(keys.everything_of(VESSEL), lambda sample: asked.append(f"put {sample.key_expr}"))
    return asked


def answered(session, key):
    return [reply.ok.payload.to_bytes() for reply in session.get(key, timeout=30) if reply.ok] == [b"stored"]


def test_shore_sends_comment_and_commands_only(world, relay):
    with world.open("shore-1", endpoint=world.vessel_tls) as shore:
        eventually(lambda: answered(shore, COMMENT), what="comment")
        assert answered(shore, COMMAND)
        assert not answered(shore, DECISION)
        assert not answered(shore, IMAGE)
        shore.put(keys.image_reconstructed(VESSEL), b"false")
        shore.put(keys.contact_decision(VESSEL), b"false")
        shore.put(keys.comment(VESSEL), b"true")
        eventually(lambda: f"put {keys.comment(VESSEL)}" in relay, what="the comment as a publication")
    assert not {DECISION, IMAGE} & set(relay)
    assert f"put {keys.image_reconstructed(VESSEL)}" not in relay
    assert f"put {keys.contact_decision(VESSEL)}" not in relay
    world.vessel.wait_for_denial("shore-1", "Query", DECISION)
    world.vessel.wait_for_denial("shore-1", "Put", keys.image_reconstructed(VESSEL))


def test_vessel_console_sends_decisions_and_commands_and_receives_comment(world, relay, vessel_session):
    taken = keys.delivery_query(keys.comment(VESSEL), "console")
    with world.open("console-1", endpoint=world.vessel_tls) as console:
        eventually(lambda: answered(console, DECISION), what="the decision")
        assert answered(console, COMMAND)
        assert not answered(console, IMAGE)
        console.declare_queryable(taken, lambda query: query.reply(query.key_expr, b"stored"))
        eventually(lambda: answered(vessel_session, taken), what="comments for the console")
    assert IMAGE not in relay
    world.vessel.wait_for_denial("console-1", "Query", IMAGE)


def test_ca_file_can_hold_two_authorities_during_a_change(world, tmp_path):
    young = Fleet.init(tmp_path / "young", "young")
    folder = young.issue("vessel-9", "vessel").folder
    (folder / "ca.pem").write_bytes((world.fleet.folder / "ca.pem").read_bytes() + (folder / "ca.pem").read_bytes())
    assert check_tls_files(tls_of(folder), time.time()).common_name == "vessel-9"
