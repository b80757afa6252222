"""What the v1 sender knows of its receivers by their reports: what each lacks, and the loss to each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from sonarpost.link.coding.blocks import SendBlock
from sonarpost.link.coding.redundancy_plan import symbols_to_send
from sonarpost.link.config import SenderConfig
from sonarpost.link.frames.v1.feedback import NEVER_RECEIVED, WINDOW, Feedback
from sonarpost.link.frames.v1.frame import BLOCKS

_LEAST_TO_MEASURE: Final = 16


@dataclass(eq=False)
class LossMeter:
    """Measures loss by comparing what was sent between two reports with what arrived.

    Attributes:
        loss: The measure, None before the second report.
        told: Frames sent and frames arrived when the last report was used.
    """

    loss: float | None = None
    told: tuple[int, int] | None = None

    def take(self, report: Feedback, frames_sent: int) -> None:
        """Take a report; the newest stretch counts for a quarter. Stretches of fewer than 16 frames are joined."""
        if self.told is not None:
            sent = frames_sent - self.told[0]
            if sent < _LEAST_TO_MEASURE:
                return
            loss = min(max(1.0 - ((report.frames - self.told[1]) % 65536) / sent, 0.0), 1.0)
            self.loss = loss if self.loss is None else 0.75 * self.loss + 0.25 * loss
        self.told = (frames_sent, report.frames)


@dataclass(eq=False)
class FeedbackTracker:
    """The receivers that report.

    Attributes:
        receivers: When each reported last, by modem address.
        meters: What measures the loss to each.
    """

    receivers: dict[int, float] = field(default_factory=dict)
    meters: dict[int, LossMeter] = field(default_factory=dict)

    @property
    def loss(self) -> float | None:
        """Share of frames lost on the way to the worst receiver; None before the second report of any."""
        known = [m.loss for r, m in self.meters.items() if m.loss is not None and r in self.receivers]
        return max(known, default=None)

    def take(
        self,
        report: Feedback,
        blocks: Sequence[SendBlock],
        config: SenderConfig,
        now: float,
        receiver: int,
        frames_sent: int,
    ) -> tuple[list[SendBlock], list[SendBlock]]:
        """Take a report; return the blocks that some receiver still lacks, planned anew, and those that all have."""
        self.meters.setdefault(receiver, LossMeter()).take(report, frames_sent)
        return self.apply(report, blocks, config, now, receiver)

    def apply(
        self, report: Feedback, blocks: Sequence[SendBlock], config: SenderConfig, now: float, receiver: int
    ) -> tuple[list[SendBlock], list[SendBlock]]:
        """As `take`, without measuring the loss."""
        self.receivers[receiver] = now
        self.receivers = {r: at for r, at in self.receivers.items() if at + config.receiver_memory_s >= now}
        self.meters = {r: meter for r, meter in self.meters.items() if r in self.receivers}
        done = [block for block in blocks if self._is_done(block, report, config, now, receiver)]
        return [block for block in blocks if block not in done], done

    def _is_done(self, block: SendBlock, report: Feedback, config: SenderConfig, now: float, receiver: int) -> bool:
        need = report.need_of(block.number)
        if need is None:
            behind = (report.newest - block.number) % BLOCKS
            if behind >= WINDOW or block.reported or len(report.needs) < 2:
                return False  # newer than anything heard, told before, or a report of one block only
            need = NEVER_RECEIVED
        block.reported = block.reported or need != NEVER_RECEIVED
        block.asked_at = now
        block.needs[receiver] = block.source_symbols if need == NEVER_RECEIVED else need
        if max(block.needs.get(known, block.source_symbols) for known in self.receivers) == 0:
            return True
        if need > 0:
            more = symbols_to_send(block.needs[receiver], config.worst, config.caution)
            block.planned = max(block.sent + more, block.planned if len(self.receivers) > 1 else 0)
        return False
