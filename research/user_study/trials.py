"""A blind forced choice: people see decoded pictures and say of which original each is."""

from __future__ import annotations

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from research.user_study.intervals import clopper_pearson, wilson
from sonarpost.errors import ConfigError

NONE_OF_THEM = -1


@dataclass(frozen=True, slots=True)
class Decoded:
    """A decoded picture.

    Attributes:
        group: What it is counted with, for example a codec at a length; empty for all that are in no folder.
        name: Of the original.
    """

    group: str
    name: str


@dataclass(frozen=True, slots=True)
class Trial:
    """One question.

    Attributes:
        shown: The decoded picture.
        choices: Names of the originals offered, in the order of the page; one is right.
    """

    shown: Decoded
    choices: tuple[str, ...]

    @property
    def right(self) -> int:
        """Index of the right choice."""
        return self.choices.index(self.shown.name)


def trials_for(
    person: str, seed: int, originals: Sequence[str], decoded: Iterable[Decoded], choices: int
) -> tuple[Trial, ...]:
    """Return the questions for a person in their order; the same person and seed get the same ones.

    Args:
        person: Everybody gets an order of their own.
        seed: Of the panel.
        originals: Names of the originals.
        decoded: What is shown; each is shown once.
        choices: How many originals are offered at a time.

    Raises:
        ConfigError: There are fewer originals than choices, or a decoded picture has no original.
    """
    known = sorted(set(originals))
    if not 2 <= choices <= len(known):
        raise ConfigError("user_study", "--choices", choices, f"2 to {len(known)}, the number of originals")
    chance = random.Random(f"{seed}/{person}")
    wanted = sorted(set(decoded), key=lambda one: (one.group, one.name))
    found = []
    for one in wanted:
        if one.name not in known:
            raise ConfigError("user_study", "--decoded", f"{one.group}/{one.name}", "a picture with an original")
        others = chance.sample([name for name in known if name != one.name], choices - 1)
        offered = [one.name, *others]
        chance.shuffle(offered)
        found.append(Trial(one, tuple(offered)))
    chance.shuffle(found)
    return tuple(found)


@dataclass(frozen=True, slots=True)
class Answer:
    """What a person chose.

    Attributes:
        person: Who.
        group: Of the decoded picture.
        right: Whether it was the right one.
        seconds: How long it took.
    """

    person: str
    group: str
    right: bool
    seconds: float


def share(answers: Sequence[Answer]) -> dict[str, object]:
    """Return how many answers were right, with both intervals of 95 % and the median time."""
    right, number = sum(answer.right for answer in answers), len(answers)
    times = sorted(answer.seconds for answer in answers)
    return {
        "answered": number,
        "right": right,
        "share": right / number if number else None,
        "wilson": list(wilson(right, number)),
        "exact": list(clopper_pearson(right, number)),
        "median_s": times[number // 2] if number else None,
    }


def results(answers: Sequence[Answer], choices: int) -> dict[str, object]:
    """Return the table of a panel: by person, by group, and pooled.

    Pooled answers of several people are not independent of one another where they saw the same pictures: its intervals
    are too narrow for a claim about other people, which `people` is for.
    """
    by_person: dict[str, list[Answer]] = {}
    by_group: dict[str, list[Answer]] = {}
    for answer in answers:
        by_person.setdefault(answer.person, []).append(answer)
        by_group.setdefault(answer.group, []).append(answer)
    return {
        "chance": 1 / choices,
        "people": [{"name": name, **share(given)} for name, given in sorted(by_person.items())],
        "by_group": {group: share(given) for group, given in sorted(by_group.items())},
        "pooled": share(answers),
    }


def table(found: Mapping[str, object]) -> str:
    """Return what `results` found as text, a row a line."""
    rows = [("", "right", "of", "share", "95 % (Wilson)", "95 % (exact)")]
    people, groups = found["people"], found["by_group"]
    assert isinstance(people, list)
    assert isinstance(groups, dict)
    rows += [_row(str(person["name"]), person) for person in people]
    rows += [_row(f"[{group}]", one) for group, one in groups.items() if group]
    pooled = found["pooled"]
    assert isinstance(pooled, dict)
    rows.append(_row("all", pooled))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join([*lines, f"by chance {found['chance']:.2f}"])


def _row(name: str, one: Mapping[str, object]) -> tuple[str, str, str, str, str, str]:
    part = "" if one["share"] is None else f"{one['share']:.2f}"
    return name, str(one["right"]), str(one["answered"]), part, _interval(one["wilson"]), _interval(one["exact"])


def _interval(pair: object) -> str:
    assert isinstance(pair, list)
    return f"{pair[0]:.2f} to {pair[1]:.2f}"
