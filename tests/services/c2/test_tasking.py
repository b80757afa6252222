"""Comments and commands from the shore to the vessel: delivered exactly once, with their state shown at the shore."""

import msgpack
import pytest
import zenoh
from builders.common import eventually, free_port

from research.common.link_emulator import LinkEmulator
from sonarpost import keys, wire
from sonarpost.archive.shore_index import ShoreIndex
from sonarpost.bus.session import router_config
from sonarpost.errors import StoredFileError
from sonarpost.messages import Command, Comment, TaskingState
from sonarpost.services.relay.config import RelayConfig
from sonarpost.services.relay.service import RelayService

COMMENT, COMMAND = keys.tasking_comment("vessel-1"), keys.tasking_command("vessel-1")


@pytest.fixture
def relay(runner, platform):
    def make(comment=("console",), commands=("op_modem",)):
        config = RelayConfig(comment_consumers=comment, command_consumers=commands)
        return runner.start(RelayService(platform("vessel-1"), config))

    return make


@pytest.fixture
def expert(runner):
    return runner.peer("shore-1", "expert")


@pytest.fixture
def console(runner):
    return lambda: runner.peer("vessel-1", "console", {keys.comment("vessel-1"): Comment})


@pytest.fixture
def op_modem(runner):
    return lambda: runner.peer("vessel-1", "op_modem", {keys.command_all("vessel-1"): Command})


def comment(comment_id="a1", vessel="vessel-1", **changes):
    fields = {
        "comment_id": comment_id,
        "vessel_id": vessel,
        "vehicle_id": "uuv-1",
        "image_id": "AAAA",
        "image_version": 2,
        "verdict": "mine_like",
        "remark": "look again",
        "author": "expert",
        "commented_utc_s": 5.0,
    }
    return Comment(**(fields | changes))


def command(command_id="c1", kind="refine"):
    return Command(
        command_id=command_id, kind=kind, vehicle_id="uuv-1", image_id="AAAA", issued_by="expert", issued_utc_s=6.0
    )


def states(out):
    """Delivery states by vessel, kind and identifier; empty while there is no index."""
    try:
        index = ShoreIndex(out, writable=False)
    except StoredFileError:
        return {}
    try:
        return {(row.vessel_id, row.kind, row.record_id): row.state for row in index.tasking()}
    finally:
        index.close()


def test_comment_and_command_reach_their_consumers_on_the_vessel(begin, relay, expert, console, op_modem, out, watch):
    shown, aboard = watch(keys.tasking_state("vessel-1")), watch("sonarpost/v1/vessel-1/**")
    service = begin()
    relay()
    screen, modem = console(), op_modem()
    expert.send(COMMENT, "c2", comment())
    expert.send(COMMAND, "c2", command())
    eventually(lambda: screen.received == [comment()] and modem.received == [command()])
    eventually(lambda: set(states(out).values()) == {"delivered"})
    assert set(states(out)) == {("vessel-1", "comment", "a1"), ("vessel-1", "command", "c1")}
    eventually(lambda: len(shown) >= 2)
    told = [msgpack.unpackb(sample.payload.to_bytes()) for sample in shown]
    assert {(t["type"], t["state"]) for t in told} <= {(TaskingState.TYPE, s) for s in ("waiting", "delivered")}
    # On the vessel, only the relay publishes them.
    eventually(lambda: len([s for s in aboard if "/health/" not in str(s.key_expr)]) == 2)
    assert service.health().counters["tasking_accepted"] == 2


def test_comment_waits_for_an_unreachable_vessel(begin, relay, expert, console, out, runner):
    service = begin()
    expert.send(COMMENT, "c2", comment("a1"), comment("a2"))
    eventually(lambda: service.gauges()["waiting_for_vessels"] == 2)
    eventually(lambda: list(states(out).values()) == ["waiting"] * 2)
    runner.stop(service)
    service = begin()
    assert service.gauges()["waiting_for_vessels"] == 2
    screen = console()
    relay(commands=())
    eventually(lambda: [a.comment_id for a in screen.received] == ["a1", "a2"])
    eventually(lambda: list(states(out).values()) == ["delivered"] * 2)
    assert service.gauges()["waiting_for_vessels"] == 0


def test_comment_arrives_once_after_a_link_cut(begin, runner, platform, expert, out, tmp_path, router):
    """Two routers, linked through a connection that can be cut."""
    link = LinkEmulator(int(router.rpartition(":")[2]))
    vessel_endpoint = f"tcp/127.0.0.1:{free_port()}"
    vessel_router = zenoh.open(router_config([vessel_endpoint], [f"tcp/127.0.0.1:{link.port}"]))
    aboard = platform("vessel-1").model_copy(update={"router": (vessel_endpoint,)})
    screen_type = type("Console", (type(expert),), {"NAME": "console"})
    try:
        service = begin()
        runner.start(RelayService(aboard, RelayConfig(comment_consumers=("console",))))
        screen = runner.start(screen_type(aboard, {keys.comment("vessel-1"): Comment}))
        expert.send(COMMENT, "c2", comment("before"))
        eventually(lambda: [a.comment_id for a in screen.received] == ["before"])
        eventually(lambda: states(out).get(("vessel-1", "comment", "before")) == "delivered")
        link.cut()
        expert.send(COMMENT, "c2", comment("later"))
        eventually(lambda: states(out).get(("vessel-1", "comment", "later")) == "waiting")
        eventually(lambda: not service.is_responding("relay@vessel-1"))
        assert [a.comment_id for a in screen.received] == ["before"]
        link.mend()
        eventually(lambda: [a.comment_id for a in screen.received] == ["before", "later"])
        eventually(lambda: states(out).get(("vessel-1", "comment", "later")) == "delivered")
    finally:
        runner.stop_all()
        vessel_router.close()
        link.close()


def test_unreachable_vessel_does_not_delay_others(begin, relay, expert, console, out):
    begin()
    relay()
    screen = console()
    expert.send(keys.tasking_comment("vessel-9"), "c2", comment("far", vessel="vessel-9"))
    eventually(lambda: states(out) == {("vessel-9", "comment", "far"): "waiting"})
    expert.send(COMMENT, "c2", comment("near"))
    eventually(lambda: [a.comment_id for a in screen.received] == ["near"])
    eventually(lambda: states(out)["vessel-1", "comment", "near"] == "delivered")
    assert states(out)["vessel-9", "comment", "far"] == "waiting"


def test_record_without_a_consumer_is_refused_with_a_state_at_the_shore(begin, relay, expert, out, refused):
    service = begin()
    relay(comment=(), commands=())
    expert.send(COMMENT, "c2", comment())
    expert.send(COMMAND, "c2", command())
    eventually(lambda: list(states(out).values()) == ["refused"] * 2)
    reasons = [reason for _, reason in refused(service)]
    assert any("a name in [relay] comment_consumers" in reason for reason in reasons)
    index = ShoreIndex(out, writable=False)
    assert all("no consumer on vessel-1" in row.reason for row in index.tasking())
    index.close()


def test_repeated_comment_is_accepted_once_and_a_conflicting_one_refused(begin, relay, expert, console, refused):
    service = begin()
    relay()
    screen = console()
    expert.send(COMMENT, "c2", comment(), comment())
    eventually(lambda: service.health().counters.get("tasking_repeated") == 1)
    expert.send(COMMENT, "c2", comment(remark="something else"), comment("a2"))
    eventually(lambda: [a.comment_id for a in screen.received] == ["a1", "a2"])
    eventually(lambda: len(refused(expert)) == 1)
    assert "comment_id: got 'a1', expected an identifier that no other record" in refused(expert)[0][1]


@pytest.mark.parametrize(
    ("key", "record", "field"),
    [(COMMENT, comment(vessel="vessel-2"), "vessel_id"), (COMMENT, command(), "type"), (COMMAND, comment(), "type")],
)
def test_record_for_another_vessel_than_the_key_is_refused(key, record, field, begin, expert, refused):
    service = begin()
    expert.send(key, "c2", record)
    eventually(lambda: len(refused(expert)) == 1)
    assert f"{field}: got" in refused(expert)[0][1]
    assert service.gauges()["waiting_for_vessels"] == 0


def test_relay_refuses_comment_of_another_vessel_and_command_of_another_kind(relay, runner, refused):
    relay()
    other = runner.peer("shore-9", "c2")
    other.send(keys.comment("vessel-1"), "relay", comment(vessel="vessel-2"))
    other.send(keys.command("vessel-1", "resend"), "relay", command(kind="refine"))
    eventually(lambda: len(refused(other)) == 2)
    reasons = " ".join(reason for _, reason in refused(other))
    assert "vessel_id: got 'vessel-2', expected vessel-1" in reasons
    assert "kind: got 'refine', expected the kind in the key" in reasons


def test_publication_on_the_vessel_is_ignored_by_the_relay(relay, console, publish):
    """The console receives it directly; the relay would deliver it twice."""
    service, screen = relay(), console()
    publish(keys.comment("vessel-1"), wire.encode(comment()))
    eventually(lambda: len(screen.received) == 1)
    assert "comments_taken" not in service.health().counters
    assert service.store.inbox_depth() == 0


def test_tasking_state_that_cannot_be_read_or_published_delays_no_other(runner, expert, relay, op_modem, begin, out):
    service = begin()
    with service.store.transaction() as tx:
        tx.put_state("tasking/vessel-1/comment/a1", b"\xc1")
        tx.put_state("tasking/vessel-1/command/c0", msgpack.packb(["vessel-1", "command", b"x", "waiting", "", 0.0]))
        tx.put_state("archive-owner", b"\xff")
    runner.stop(service)
    service = begin()
    store_tasking = service._archive.store_tasking

    def store_or_fail(rows):
        if rows[0].record_id == "c1":
            raise RuntimeError("a defect")
        store_tasking(rows)

    service._archive.store_tasking = store_or_fail
    expert.send(COMMAND, "c2", command("c1"), command("c2"))
    relay()
    op_modem()
    eventually(lambda: states(out).get(("vessel-1", "command", "c2")) == "delivered")
    eventually(lambda: "tasking: RuntimeError: a defect" in service.health().detail)
    assert len(service._owner()) == 32
    assert service.health().counters["states_discarded"] == 3
    service._archive.store_tasking = store_tasking
    eventually(lambda: states(out).get(("vessel-1", "command", "c1")) == "delivered")
