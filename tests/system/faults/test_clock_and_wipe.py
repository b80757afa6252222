"""Clocks that jump, and a vessel whose disk is exchanged."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from builders.coast import PROCESSES, Coast
from builders.feeder import make_image

COUNT = 200
DAY_S = 86400.0


class Clock:
    """The clock of some processes; `jump` sets it while they run."""

    def __init__(self, file: Path, text: Callable[[float], str]) -> None:
        self._file = file
        self._text = text
        self.jump(0.0)

    def jump(self, offset_s: float) -> None:
        """Set the clock to so much more than the true time."""
        hidden = self._file.with_suffix(".new")
        hidden.write_text(self._text(offset_s))
        hidden.replace(self._file)


def libfaketime() -> str:
    """Return the path of the library, or skip."""
    for folder in ("x86_64-linux-gnu", "aarch64-linux-gnu"):
        path = Path(f"/usr/lib/{folder}/faketime/libfaketime.so.1")
        if path.is_file():
            return str(path)
    pytest.skip("libfaketime is not installed (Debian package faketime)")


@pytest.fixture(params=["python", pytest.param("libfaketime", marks=pytest.mark.long)])
def clocked(
    request: pytest.FixtureRequest, tmp_path: Path, start_coast: Callable[..., Coast]
) -> tuple[Coast, dict[str, Clock]]:
    """A coast whose vessel and shore have a clock each: of relay and c2 in Python, or of all four processes in libc."""
    clocks = {side: tmp_path / f"clock-{side}" for side in ("vessel", "shore")}
    if request.param == "python":
        made = {side: Clock(file, str) for side, file in clocks.items()}
        script = str(Path(__file__).with_name("shifted_clock.py"))
        launcher = {
            "relay": (sys.executable, script, str(clocks["vessel"])),
            "c2": (sys.executable, script, str(clocks["shore"])),
        }
        return start_coast(launcher=launcher), made
    library = libfaketime()
    made = {side: Clock(file, lambda offset_s: f"{offset_s:+.0f}s") for side, file in clocks.items()}
    environment = {
        name: {
            "LD_PRELOAD": library,
            "FAKETIME_TIMESTAMP_FILE": str(clocks["vessel" if name in ("relay", "router-vessel") else "shore"]),
            "FAKETIME_NO_CACHE": "1",
            "FAKETIME_DONT_FAKE_MONOTONIC": "1",
            "FAKETIME_DONT_RESET": "1",
        }
        for name in PROCESSES
    }
    return start_coast(environment=environment), made


def test_clocks_that_jump_lose_and_double_nothing(clocked: tuple[Coast, dict[str, Clock]]) -> None:
    coast, clocks = clocked
    coast.watch_health()
    jumps = [("vessel", 30 * DAY_S), ("shore", -365 * DAY_S), ("vessel", -2 * DAY_S), ("shore", 3600.0)]
    for part, (side, offset_s) in enumerate(jumps):
        first = 50 * part
        coast.owe([make_image(n) for n in range(first, first + 50)])
        coast.until(lambda first=first: coast.ashore_count() > first, 60, "some of this part ashore")
        clocks[side].jump(offset_s)
        service = "relay" if side == "vessel" else "c2"
        wanted_utc_s = time.time() + offset_s
        coast.until(
            lambda service=service, wanted=wanted_utc_s: (
                service in coast.health and abs(coast.health[service].time_utc_s - wanted) < 120
            ),
            30,
            f"{service} has seen its clock jump",
        )
        if part == 1:
            # A process that starts under the wrong clock finds what it has left in order, too.
            for name in ("relay", "c2"):
                coast.kill(name)
                coast.start(name)
    coast.assert_all_ashore_once()


def test_a_vessel_with_a_new_disk_doubles_nothing_and_is_taken_as_new(coast: Coast) -> None:
    old = [make_image(n) for n in range(COUNT)]
    coast.owe(old)
    coast.assert_all_ashore_once()
    files = {p: (p.stat().st_ino, p.stat().st_mtime_ns) for p in coast.out.rglob("uuv-*")}
    assert len(files) == 3 * COUNT
    coast.stop_feeder()
    coast.kill("relay")
    coast.wipe_vessel()
    coast.start("relay")
    coast.start_feeder()
    # The new stores begin at number 1 again. Forty of the old pictures come a second time, as they would from a
    # decompressor that kept its own disk; the others are new, of vehicles that begin their identifiers anew as well.
    repeated = old[::5]
    new = [make_image(n, mission=1) for n in range(COUNT)]
    coast.feeder.owe(repeated)
    coast.feeder.owe(new)
    coast.until(lambda: coast.ashore_count() >= 2 * COUNT, 60, "new pictures ashore")
    coast.until(lambda: coast.accepted("c2") == 2 * COUNT + len(repeated), 60, "c2 has taken all")
    coast.until(lambda: coast.depths("c2")["inbox"] == 0, 60, "c2 has handled all")
    assert {p: (p.stat().st_ino, p.stat().st_mtime_ns) for p in files} == files, "the old files are untouched"
    assert sum(1 for _ in coast.out.rglob("uuv-*")) == 6 * COUNT
    found = coast.pixels_by_file()
    assert sorted(found.values()) == sorted([i.picture_sha256 for i in (*old, *new)])
    assert coast.log_text("c2").count("Image already stored") == len(repeated)
