"""Trials of the user study and the evaluation of its answers.

A participant sees each decoded image once, in random order, and selects its original among several.
"""

import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from scipy.stats import binomtest

from sonarpost.errors import ConfigError

NONE_OF_THEM = -1


@dataclass(frozen=True, slots=True)
class Decoded:
    """A decoded image.

    Attributes:
        group: Group in the results, for example a codec at a length; empty for images without a folder.
        name: Name of the original.
    """

    group: str
    name: str


@dataclass(frozen=True, slots=True)
class Trial:
    """One question.

    Attributes:
        shown: The decoded image.
        choices: Names of the originals on the page, in order; one is right.
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
    """Return the trials of a participant in order; the same participant and seed give the same trials.

    Args:
        person: Name of the participant, which determines the order.
        seed: Seed of the study.
        originals: Names of the originals.
        decoded: The decoded images; each appears once.
        choices: Number of originals in a trial.

    Raises:
        ConfigError: There are fewer originals than choices, or a decoded image has no original.
    """
    known = sorted(set(originals))
    if not 2 <= choices <= len(known):
        raise ConfigError("user_study", "--choices", choices, f"2 to {len(known)}, the number of originals")
    rng = random.Random(f"{seed}/{person}")
    trials = []
    for one in sorted(set(decoded), key=lambda one: (one.group, one.name)):
        if one.name not in known:
            raise ConfigError("user_study", "--decoded", f"{one.group}/{one.name}", "an image with an original")
        others = rng.sample([name for name in known if name != one.name], choices - 1)
        offered = [one.name, *others]
        rng.shuffle(offered)
        trials.append(Trial(one, tuple(offered)))
    rng.shuffle(trials)
    return tuple(trials)


@dataclass(frozen=True, slots=True)
class Answer:
    """An answer of a participant.

    Attributes:
        person: Name of the participant.
        group: Group of the decoded image.
        right: Whether the choice was right.
        seconds: Response time.
    """

    person: str
    group: str
    right: bool
    seconds: float


def share(answers: Sequence[Answer]) -> dict[str, object]:
    """Return the share of right answers with the 95 % intervals of Wilson and of Clopper and Pearson (exact)."""
    right, number = sum(answer.right for answer in answers), len(answers)
    times = sorted(answer.seconds for answer in answers)
    intervals = {
        method: list(binomtest(right, number).proportion_ci(method=method)) if number else [0.0, 1.0]
        for method in ("wilson", "exact")
    }
    return {
        "answered": number,
        "right": right,
        "share": right / number if number else None,
        **intervals,
        "median_s": times[number // 2] if number else None,
    }


def results(answers: Sequence[Answer], choices: int) -> dict[str, object]:
    """Return the results by participant, by group, and pooled.

    Pooled answers are not independent, because the participants saw the same images. Their intervals are too narrow
    for statements about other people; use those of `people`.
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
    """Return the results as a text table."""
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
