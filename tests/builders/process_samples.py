"""Memory, descriptors, threads and files of a running chain, sampled over a run."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sonarpost.extensions.simulation.demo.chain import Chain


@dataclass(frozen=True)
class ProcessSample:
    """One process at one time.

    Attributes:
        contacts: Contacts delivered so far.
        rss_mb: Resident memory in MB.
        descriptors: Open file descriptors.
        threads: Threads.
    """

    contacts: int
    rss_mb: float
    descriptors: int
    threads: int


def sample_process(pid: int, contacts: int) -> ProcessSample:
    """Return a sample of a running process."""
    status = dict(
        line.split(":", 1)
        for line in Path(f"/proc/{pid}/status").read_text(encoding="utf-8").splitlines()
        if ":" in line
    )
    descriptors = sum(1 for _ in Path(f"/proc/{pid}/fd").iterdir())
    return ProcessSample(contacts, int(status["VmRSS"].split()[0]) / 1024, descriptors, int(status["Threads"]))


def folder_bytes(paths: Iterable[Path]) -> int:
    """Return the size of all files below some folders, or of files."""
    total = 0
    for path in paths:
        for file in path.rglob("*") if path.is_dir() else (path,):
            try:
                total += file.stat().st_size if file.is_file() else 0
            except FileNotFoundError:
                continue  # removed since it was listed
    return total


class Samples:
    """Samples of all processes and folders of a chain.

    Args:
        chain: The running chain.
        folders: Files and folders by the name of their row in the table.
    """

    def __init__(self, chain: Chain, folders: dict[str, list[Path]]) -> None:
        self._chain = chain
        self._folders = folders
        self.processes: dict[str, list[ProcessSample]] = {}
        self.sizes: dict[str, list[tuple[int, int]]] = {}

    def take(self, contacts: int) -> None:
        """Sample every process that runs, and every folder."""
        for name in self._chain.names:
            if self._chain.status(name) is None:
                self.processes.setdefault(name, []).append(sample_process(self._chain.pid(name), contacts))
        for name, paths in self._folders.items():
            self.sizes.setdefault(name, []).append((contacts, folder_bytes(paths)))

    @staticmethod
    def nearest(samples: list[ProcessSample], contacts: float) -> ProcessSample:
        """Return the sample that is nearest to a number of contacts."""
        return min(samples, key=lambda sample: abs(sample.contacts - contacts))

    @staticmethod
    def growth(points: list[tuple[int, float]], first: float) -> float:
        """Return the slope for 1,000 contacts of the points from `first` contacts on, by linear regression."""
        late = [(x, y) for x, y in points if x >= first]
        if len({x for x, _ in late}) < 2:
            return 0.0
        x, y = np.array(late, dtype=float).T
        return float(1000.0 * np.polyfit(x, y, 1)[0])

    def table(self, contacts: int) -> str:
        """Return two Markdown tables: processes (descriptors and threads at 25 and 100 %), and files."""
        quarter, late = contacts / 4, 0.6 * contacts
        lines = [
            "| process | MB at 25, 50, 75, 100 % | MB per 1,000 contacts, from 60 % on | descriptors | threads |",
            "|---|---|---|---|---|",
        ]
        for name, samples in self.processes.items():
            at = [self.nearest(samples, quarter * part) for part in (1, 2, 3, 4)]
            growth = self.growth([(s.contacts, s.rss_mb) for s in samples], late)
            memory = ", ".join(f"{sample.rss_mb:.0f}" for sample in at)
            lines.append(
                f"| {name} | {memory} | {growth:+.1f} | {at[0].descriptors}, {at[3].descriptors} "
                f"| {at[0].threads}, {at[3].threads} |"
            )
        lines += ["", "| files | kB at 25, 50, 75, 100 % | kB per 1,000 contacts, from 60 % on |", "|---|---|---|"]
        for name, points in self.sizes.items():
            at_bytes = [min(points, key=lambda p, x=quarter * part: abs(p[0] - x))[1] for part in (1, 2, 3, 4)]
            growth = self.growth([(x, y / 1000) for x, y in points], late)
            sizes = ", ".join(f"{size / 1000:.0f}" for size in at_bytes)
            lines.append(f"| {name} | {sizes} | {growth:+.0f} |")
        return "\n".join(lines)
