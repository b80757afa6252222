"""At a vessel's router: a shore that has fallen into wrong hands can advise and command and nothing else; consoles."""

from __future__ import annotations

import time

import pytest
import zenoh
from builders.common import eventually
from builders.fleet_certificates import tls_of

from sonarpost import keys
from sonarpost.security import tls_files
from sonarpost.security.fleet import Fleet

VESSEL = "vessel-1"
DECISION = keys.delivery_query(keys.contact_decision(VESSEL), "relay")
ADVICE = keys.delivery_query(keys.advice(VESSEL), "relay")
COMMAND = keys.delivery_query(keys.command(VESSEL, "resend"), "relay")
PICTURE = keys.delivery_query(keys.image_reconstructed(VESSEL), "relay")


@pytest.fixture
def relay(aboard):
    """A relay aboard, as far as its hand-overs go."""
    asked: list[str] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            asked.append(str(query.key_expr))
            query.reply(query.key_expr, b"stored")

    for key in (
        keys.contact_decision(VESSEL),
        keys.advice(VESSEL),
        keys.command_all(VESSEL),
        keys.image_reconstructed(VESSEL),
    ):
        aboard.declare_queryable(keys.delivery_query(key, "relay"), answer)
    aboard.declare_subscriber(keys.everything_of(VESSEL), lambda sample: asked.append(f"put {sample.key_expr}"))
    return asked


def answered(session: zenoh.Session, key: str) -> bool:
    return [reply.ok.payload.to_bytes() for reply in session.get(key, timeout=3) if reply.ok] == [b"stored"]


def test_the_shore_advises_and_commands_and_no_more(world, relay):
    with world.open("shore-1", endpoint=world.vessel_tls) as shore:
        eventually(lambda: answered(shore, ADVICE), what="advice")
        assert answered(shore, COMMAND)
        assert not answered(shore, DECISION)
        assert not answered(shore, PICTURE)
        shore.put(keys.image_reconstructed(VESSEL), b"false")
        shore.put(keys.contact_decision(VESSEL), b"false")
        shore.put(keys.advice(VESSEL), b"true")
        eventually(lambda: f"put {keys.advice(VESSEL)}" in relay, what="the advice as a publication")
    assert not {DECISION, PICTURE} & set(relay)
    assert f"put {keys.image_reconstructed(VESSEL)}" not in relay
    assert f"put {keys.contact_decision(VESSEL)}" not in relay
    world.vessel.wait_for("Message denied", "peer=shore-1", "message=Query", f"key={DECISION}")
    world.vessel.wait_for("Message denied", "peer=shore-1", "message=Put", f"key={keys.image_reconstructed(VESSEL)}")


def test_a_console_aboard_decides_and_commands_and_takes_advice(world, relay, aboard):
    taken = keys.delivery_query(keys.advice(VESSEL), "console")
    with world.open("console-1", endpoint=world.vessel_tls) as console:
        eventually(lambda: answered(console, DECISION), what="the decision")
        assert answered(console, COMMAND)
        assert not answered(console, PICTURE)
        console.declare_queryable(taken, lambda query: query.reply(query.key_expr, b"stored"))
        eventually(lambda: answered(aboard, taken), what="advice for the console")
    assert PICTURE not in relay
    world.vessel.wait_for("Message denied", "peer=console-1", "message=Query", f"key={PICTURE}")


def test_a_console_ashore_hands_in_advice_and_no_picture(world, ashore):
    advice = keys.delivery_query(keys.tasking_advice(VESSEL), "c2")

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, b"stored")

    ashore.declare_queryable(keys.delivery_query(keys.tasking_advice_all(), "c2"), answer)
    ashore.declare_queryable(keys.delivery_query(keys.shore_inbox_all(), "c2"), answer)
    with world.open("console-1") as console:
        eventually(lambda: answered(console, advice), what="the advice")
        assert not answered(console, keys.delivery_query(keys.shore_inbox(VESSEL), "c2"))


def test_another_vessel_and_a_vehicle_get_nothing_at_a_vessels_door(world, relay):
    for name in ("vessel-2", "uuv-1"):
        with world.open(name, endpoint=world.vessel_tls) as stranger:
            assert not any(answered(stranger, key) for key in (ADVICE, COMMAND, DECISION, PICTURE))
        world.vessel.wait_for("A peer is on no list", f"peer={name}")
    assert relay == []


def test_two_authorities_stand_in_one_file_while_a_fleet_changes(world, tmp_path):
    young = Fleet.init(tmp_path / "young", "young")
    folder = young.issue("vessel-9", "vessel").folder
    (folder / "ca.pem").write_bytes((world.fleet.folder / "ca.pem").read_bytes() + (folder / "ca.pem").read_bytes())
    tls = tls_of(folder)
    assert tls_files.check(tls.ca, tls.certificate, tls.key, time.time()).common_name == "vessel-9"
