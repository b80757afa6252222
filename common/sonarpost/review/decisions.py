"""Which decision on a contact counts: the one rule of the console, of exports and of training data.

1. A withdrawal (`Decision.withdraws`) takes back the decision that it names. A withdrawal never counts itself: its
   verdict is that of the decision before, for receivers that act on the latest verdict alone.
2. A decision overrules the decisions that it names (`Decision.overrules`), unless it is withdrawn.
3. Of the others, the latest of each operator stands.
4. The latest standing decision counts. If one operator's verdict is mine-like and another's is not mine-like or
   unsure, the contact is disputed, and the latest mine-like decision counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from sonarpost.messages import Decision, Verdict

ReviewState = Verdict | Literal["unreviewed", "disputed"]


@dataclass(frozen=True, slots=True)
class ReviewResult:
    """Result of the decisions on a contact.

    Attributes:
        state: State of the contact.
        counting: Decision that counts; None if `state` is `unreviewed`.
        standing: Decisions that are neither withdrawn, overruled nor replaced by their operator, in the given order.
        withdrawn: Identifiers of the withdrawn decisions.
        withdrawals: Identifiers of the records that withdraw a decision.
    """

    state: ReviewState
    counting: Decision | None
    standing: tuple[Decision, ...]
    withdrawn: frozenset[str]
    withdrawals: frozenset[str]

    @property
    def is_withdrawn(self) -> bool:
        """Whether operators have withdrawn all decisions on the contact."""
        return self.counting is None and bool(self.withdrawals)


def review_result(decisions: Sequence[Decision]) -> ReviewResult:
    """Return which decision on a contact counts, by the rule of this module.

    A withdrawal that names none of the decisions is ignored: the decision that it names may arrive later.

    Args:
        decisions: All decisions on one contact, oldest first.
    """
    identifiers = {decision.decision_id for decision in decisions}
    withdrawals = frozenset(d.decision_id for d in decisions if d.withdraws is not None)
    withdrawn = frozenset(d.withdraws for d in decisions if d.withdraws in identifiers)
    valid = [d for d in decisions if d.decision_id not in withdrawn | withdrawals]
    overruled = {name for d in valid for name in d.overrules if name in identifiers and name != d.decision_id}
    latest = {d.operator: d for d in valid if d.decision_id not in overruled}
    standing = tuple(d for d in valid if latest.get(d.operator) is d)
    verdicts = {d.verdict for d in standing}
    mine_like = [d for d in standing if d.verdict == "mine_like"]
    state: ReviewState = "unreviewed"
    counting: Decision | None = None
    if mine_like and len(verdicts) > 1:
        state, counting = "disputed", mine_like[-1]
    elif standing:
        counting = standing[-1]
        state = counting.verdict
    return ReviewResult(state, counting, standing, withdrawn, withdrawals)
