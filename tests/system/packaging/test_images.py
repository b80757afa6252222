"""`make images`: its progress, and that it installs nothing on the host without consent."""

import os
import re
import subprocess
from pathlib import Path

import pytest
from builders.common import REPOSITORY

NEEDED = ("bash", "sh", "sed", "head", "tail", "mktemp", "rm", "timeout", "dirname", "awk", "ls", "cat")


def program(folder, name, script):
    path = folder / name
    assert not path.is_symlink(), "writing would change a program of this host"
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)


@pytest.fixture
def host(tmp_path):
    """Programs of a host without debootstrap, whose container engine has no image and reaches no registry."""
    folder = tmp_path / "bin"
    folder.mkdir()
    for name in NEEDED:
        [found] = [path for place in ("/usr/bin", "/bin") if (path := Path(place, name)).exists()][:1]
        (folder / name).symlink_to(found)
    program(folder, "docker", 'case "$1" in info) ;; pull) echo "no registry" >&2; exit 1 ;; *) exit 1 ;; esac')
    program(folder, "id", 'case "$1" in -u) echo 0 ;; -un) echo root ;; esac')
    program(folder, "apt-get", f'echo "$*" >> {tmp_path}/apt-get.txt; exit 7')
    return folder


def images(host, **variables):
    return subprocess.run(
        ["bash", "packaging/images.sh"],
        cwd=REPOSITORY,
        env={"PATH": str(host), "TMPDIR": str(host.parent), **variables},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        check=False,
    )


def test_nothing_is_installed_without_consent(host, tmp_path):
    done = images(host)
    assert done.returncode == 2, done.stderr
    assert (
        "debootstrap: got no such program, expected it on this host: run 'apt-get update && apt-get install -y "
        "--no-install-recommends debootstrap', or 'make images INSTALL=yes'" in done.stderr
    )
    assert not (tmp_path / "apt-get.txt").exists()


def test_consent_installs(host, tmp_path):
    assert images(host, INSTALL="yes").returncode == 7
    assert (tmp_path / "apt-get.txt").read_text() == "update\n"


def test_missing_engine_and_missing_rights_are_named(host):
    program(host, "id", 'case "$1" in -u) echo 1000 ;; -un) echo anna ;; esac')
    done = images(host)
    assert done.returncode == 2
    assert "user: got anna, expected root, which debootstrap needs: sudo make images" in done.stderr
    (host / "docker").unlink()
    done = images(host)
    assert done.returncode == 2
    assert "docker: got no such program" in done.stderr


def progress(before, script, **variables):
    return subprocess.run(
        ["bash", "-euo", "pipefail", "-c", f". packaging/progress.sh; {before}progress images sh -c '{script}'"],
        cwd=REPOSITORY,
        env={**os.environ, **variables},
        capture_output=True,
        text=True,
        check=False,
    )


def test_steps_are_shown_and_no_step_is_silent(tmp_path):
    """The last step lasts until its line was shown three times."""
    shown = tmp_path / "shown"
    shown.touch()
    step = f'until [ "$(grep -c Collecting {shown})" -ge 3 ]; do sleep 0.1; done'
    script = f'echo "Step 1/2 : FROM base"; echo "Step 2/2 : RUN pip"; echo Collecting numpy; {step}'
    done = progress(f"exec > >(tee {shown}); ", script, PROGRESS_S="1")
    assert done.returncode == 0
    first, second, *others = done.stdout.splitlines()
    assert re.fullmatch(r"images: \d+ s: Step 1/2 : FROM base", first)
    assert re.fullmatch(r"images: \d+ s: Step 2/2 : RUN pip", second)
    assert len(others) >= 3
    assert all(line.startswith("images: ") and line.endswith(" s: Collecting numpy") for line in others)
    assert len(set(others)) >= 2, "with the elapsed time"
