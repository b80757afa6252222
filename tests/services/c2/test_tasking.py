"""Comments and commands from the shore to the vessel: delivered exactly once, with their state shown at the shore."""

import msgpack
import pytest
from builders.common import eventually

from sonarpost import keys, wire
from sonarpost.archive.reader import open_reader
from sonarpost.errors import StoredFileError
from sonarpost.messages import Command, Comment
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
    """Delivery states by vessel, kind and identifier; empty while there is no archive."""
    try:
        with open_reader(out) as archive:
            return {(row.vessel_id, row.kind, row.record_id): row.state for row in archive.tasking()}
    except StoredFileError:
        return {}


def test_record_without_a_consumer_is_refused_with_a_state_at_the_shore(begin, relay, expert, out, refused):
    service = begin()
    relay(comment=(), commands=())
    expert.send(COMMENT, "c2", comment())
    expert.send(COMMAND, "c2", command())
    eventually(lambda: list(states(out).values()) == ["refused"] * 2)
    reasons = [reason for _, reason in refused(service)]
    assert any("a name in [relay] comment_consumers" in reason for reason in reasons)
    with open_reader(out) as archive:
        assert all("no consumer on vessel-1" in row.reason for row in archive.tasking())


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
    store_state = service._archive.store_state

    def store_or_fail(item):
        if item.record_id == "c1":
            raise RuntimeError("a defect")
        return store_state(item)

    service._archive.store_state = store_or_fail
    expert.send(COMMAND, "c2", command("c1"), command("c2"))
    relay()
    op_modem()
    eventually(lambda: states(out).get(("vessel-1", "command", "c2")) == "delivered")
    eventually(lambda: "tasking: RuntimeError: a defect" in service.health().detail)
    assert len(service._owner()) == 32
    assert service.health().counters["states_discarded"] == 3
    service._archive.store_state = store_state
    eventually(lambda: states(out).get(("vessel-1", "command", "c1")) == "delivered")
