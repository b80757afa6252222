"""Invariants of `docs/specifications/delivery.md`, checked in every state and at every transition."""

from research.delivery_model.machine import Query, State, Step, World, react


def violations_in(world: World, state: State) -> list[str]:
    """Return which invariants a state violates, and why."""
    found = []
    accepted = [(key, name) for key, name, _ in state.consumer.accepted]
    sent_by_producer = [(key, name) for key, name, own in state.consumer.accepted if not own]
    for which, producer in enumerate(state.producers):
        held = {row.name for row in producer.rows}
        for record in world.queues[which][: producer.queued]:
            identity = (record.key, record.name)
            if identity not in accepted and record.name not in held and record.name not in state.excused:
                found.append(f"I1: record {record.name} is lost")
            if sent_by_producer.count(identity) > 1:
                found.append(f"I2: record {record.name} is accepted twice")
    allowed = {(record.key, record.name) for queue in world.queues for record in queue if record.valid}
    allowed |= {(key, record.name) for key in world.hostile_keys for record in world.records.values()}
    found += [
        f"I3: key {key} has {name!r}, which no writer sent" for key, name in accepted if (key, name) not in allowed
    ]
    if state.origins - len(world.queues) > world.restores - state.restores:
        found.append("I6: more new origins than restored stores")
    return found


def violations_by(world: World, before: State, step: Step) -> list[str]:
    """Return which invariants a transition violates, and why."""
    found = []
    if step.reused is not None:
        which, origin = step.reused
        if step.after.producers[which].origin == origin:
            found.append(f"I5: producer-{which + 1} has reused a number of {origin} and still uses this origin")
    if step.attack_on:
        found += _changed_by_attack(world, before, step)
    return found


def _changed_by_attack(world: World, before: State, step: Step) -> list[str]:
    """Check that a query of the hostile peer changes nothing for the keys to which it may not write."""
    found = []
    for which, producer in enumerate(before.producers):
        for row in producer.rows:
            record = world.record(row.name)
            if record.key in world.hostile_keys:
                continue
            origin = row.origin if world.rules.origin_of_row else producer.origin
            query = Query(record.key, origin, row.seq, row.name, 0, (row.name, 0), 0)
            was, now = (react(world, state.consumer, query)[1] for state in (before, step.after))
            if was != now:
                found.append(f"I4: producer-{which + 1} would receive {now!r} for {row.name}, not {was!r}")
    kept = [partial for partial in before.consumer.partials if partial.key not in world.hostile_keys]
    if any(partial not in step.after.consumer.partials for partial in kept):
        found.append("I4: the chunks of another writer's record are deleted")
    return found
