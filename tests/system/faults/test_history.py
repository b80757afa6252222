"""The checker of operation logs: it names each violation with its operations, and accepts correct runs."""

import json

import pytest
from builders.history import History, Operation, check

KEY = "sonarpost/v1/vessel-1/image/reconstructed"
DIGEST = {name: name * 64 for name in "abc"}


def run_with(*changed, without=lambda _: False):
    """Return a correct run of three records, plus some operations, without others."""
    run = [Operation("consumer", "c2", ordered=True), Operation("consumer", "subscriber", ordered=True, delivery="any")]
    run += [Operation("queued", "source", key=KEY, record=r, sha256=DIGEST[r]) for r in "abc"]
    run += [Operation("acknowledged", "source", key=KEY, record=r, sha256=DIGEST[r]) for r in "abc"]
    run += [Operation("handled", "c2", key=KEY, record=r, sha256=DIGEST[r]) for r in "abc"]
    run += [Operation("seen", "subscriber", key=KEY, record=r, sha256=DIGEST[r]) for r in "aabc"]
    run += [Operation("accepted", "c2", count=3)]
    return [*(done for done in run if not without(done)), *changed]


def handled(record, sha256=""):
    return Operation("handled", "c2", key=KEY, record=record, sha256=sha256 or DIGEST.get(record, ""))


def violations(run):
    return [(violation.rule, violation.process) for violation in check(run).violations]


def test_correct_run_passes():
    verdict = check(run_with())
    assert verdict.ok
    assert str(verdict) == "PASS: 3 records queued; handled: c2 3; 0 fault operations"


def without(operation, record):
    return lambda done: done.operation == operation and done.record == record


def seen(record, sha256=""):
    return Operation("seen", "subscriber", key=KEY, record=record, sha256=sha256)


@pytest.mark.parametrize(
    ("run", "rule", "process"),
    [
        (run_with(without=without("handled", "b")), "lost", "c2"),
        (run_with(handled("b")), "doubled", "c2"),
        (run_with(handled("x", "9" * 64)), "unknown", "c2"),
        (run_with(seen("x")), "unknown", "subscriber"),
        (run_with(seen("b", "0" * 64)), "damaged", "subscriber"),
        (run_with(handled("c", "0" * 64), without=without("handled", "c")), "damaged", "c2"),
        (run_with(handled("a"), without=without("handled", "a")), "reordered", "c2"),
        (run_with(seen("a"), without=without("seen", "a")), "reordered", "subscriber"),
        (run_with(Operation("accepted", "c2")), "miscounted", "c2"),
    ],
)
def test_each_violation_is_found_alone(run, rule, process):
    assert violations(run) == [(rule, process)]


def test_violation_shows_its_operations():
    text = str(check(run_with(without=without("handled", "b"))))
    assert text.startswith("FAIL: 1 lost; 3 records queued")
    assert "LOST at c2: b was acknowledged and is not handled" in text
    assert f"queued source {KEY} b {'b' * 12}" in text
    assert f"acknowledged source {KEY} b {'b' * 12}" in text


def test_digests_of_two_consumers_are_compared_if_the_source_states_none():
    run = [Operation("consumer", name) for name in ("vessel", "shore")]
    run += [Operation("queued", "source", record="a")]
    run += [Operation("handled", name, record="a", sha256="1" * 64) for name in ("vessel", "shore")]
    assert check(run).ok
    run[-1] = Operation("handled", "shore", record="a", sha256="2" * 64)
    assert violations(run) == [("damaged", "shore")]


def test_order_is_not_required_after_a_fault():
    run = run_with(handled("a"), without=without("handled", "a"))
    assert check([*run, Operation("fault", "relay", detail="SIGKILL")]).ok


def test_order_is_required_within_a_key_only():
    run = [Operation("consumer", "c2", ordered=True)]
    run += [Operation("queued", "source", key=key, record=r) for r in "ab" for key in ("k1", "k2")]
    run += [Operation("handled", "c2", key=key, record=r) for key in ("k2", "k1") for r in "ab"]
    assert check(run).ok


def test_consumer_of_one_key_is_not_asked_for_others():
    run = [Operation("consumer", "c2", key="k1")]
    run += [Operation("queued", "source", key=key, record="a") for key in ("k1", "k2")]
    assert check([*run, Operation("handled", "c2", key="k1", record="a")]).ok
    assert violations([*run, Operation("handled", "c2", key="k2", record="a")]) == [("lost", "c2")]


def test_record_queued_again_is_committed_again_and_handled_once():
    run = run_with(Operation("queued", "source", key=KEY, record="a", sha256=DIGEST["a"]))
    assert violations(run) == [("miscounted", "c2")]
    assert check([*run, Operation("accepted", "c2")]).ok


def test_log_without_a_consumer_is_no_proof():
    with pytest.raises(ValueError, match="got no consumer"):
        check([handled("a")])


def test_log_has_every_operation(tmp_path):
    history = History(tmp_path / "run.jsonl")
    history.add("handled", "c2", "a", key=KEY)
    history.fault("c2", "SIGKILL")
    history.close()
    lines = [json.loads(line) for line in history.path.read_text().splitlines()]
    assert [Operation(**line) for line in lines] == [*history.operations]
