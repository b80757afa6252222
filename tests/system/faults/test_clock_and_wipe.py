"""Clock jumps, and a vessel whose disk is replaced."""

import time
from pathlib import Path

import pytest
from builders.image_source import make_image
from builders.vessel_and_shore import PROCESSES

COUNT = 200
DAY_S = 86400.0


def libfaketime():
    """Return the path of the library, or skip."""
    for folder in ("x86_64-linux-gnu", "aarch64-linux-gnu"):
        path = Path(f"/usr/lib/{folder}/faketime/libfaketime.so.1")
        if path.is_file():
            return str(path)
    pytest.skip("libfaketime is not installed (Debian package faketime)")


def test_clock_jumps_of_all_processes_lose_and_duplicate_nothing(tmp_path, start_system):
    library = libfaketime()
    clocks = {side: tmp_path / f"clock-{side}" for side in ("vessel", "shore")}
    settings = {"LD_PRELOAD": library, "FAKETIME_NO_CACHE": "1", "FAKETIME_DONT_RESET": "1"}
    settings["FAKETIME_DONT_FAKE_MONOTONIC"] = "1"

    def jump(side, offset_s):
        """Set the offset from the true time while the processes run."""
        new = clocks[side].with_suffix(".new")
        new.write_text(f"{offset_s:+.0f}s")
        new.replace(clocks[side])

    for side in clocks:
        jump(side, 0.0)
    sides = {name: "vessel" if name in ("relay", "router-vessel") else "shore" for name in PROCESSES}
    environment = {name: settings | {"FAKETIME_TIMESTAMP_FILE": str(clocks[side])} for name, side in sides.items()}
    system = start_system(environment=environment)
    system.watch_health()
    jumps = [("vessel", 30 * DAY_S), ("shore", -365 * DAY_S), ("vessel", -2 * DAY_S), ("shore", 3600.0)]
    for part, (side, offset_s) in enumerate(jumps):
        first = 50 * part
        system.send([make_image(n) for n in range(first, first + 50)])
        system.wait_until(lambda first=first: system.shore_image_count() > first, "some images at the shore")
        jump(side, offset_s)
        system.history.fault(f"clock of {side}", f"{offset_s:+.0f} s")
        service = "relay" if side == "vessel" else "c2"
        expected_utc_s = time.time() + offset_s
        system.wait_until(
            lambda service=service, expected=expected_utc_s: (
                service in system.health and abs(system.health[service].time_utc_s - expected) < 1800
            ),
            f"{service} reports the new time",
        )
        if part == 1:
            # A process that starts with the wrong clock continues correctly.
            for name in ("relay", "c2"):
                system.kill(name)
                system.start(name)
    system.assert_all_delivered_once()


def test_vessel_with_a_new_disk_is_accepted_without_duplicates(system):
    old = [make_image(n) for n in range(COUNT)]
    system.send(old)
    system.assert_all_delivered_once()
    files = {p: (p.stat().st_ino, p.stat().st_mtime_ns) for p in system.out.rglob("uuv-*")}
    assert len(files) == 3 * COUNT
    system.stop_source()
    system.kill("relay")
    system.delete_vessel_stores()
    system.history.fault("vessel disk", "replaced by an empty one")
    system.start("relay")
    system.start_source()
    # The new stores number from 1. 40 of the old images are sent again, as by a decompressor with its old disk; the
    # others are new, from vehicles that also restart their identifiers.
    repeated = old[::5]
    new = [make_image(n, mission=1) for n in range(COUNT)]
    system.send(repeated)
    system.send(new)
    system.assert_all_delivered_once()
    assert {p: (p.stat().st_ino, p.stat().st_mtime_ns) for p in files} == files, "the old files are unchanged"
    assert sum(1 for _ in system.out.rglob("uuv-*")) == 6 * COUNT
    assert system.log_text("c2").count("Image already stored") == len(repeated)
