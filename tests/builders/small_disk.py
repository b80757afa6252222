"""A small file system that a test can fill."""

import os
import shutil
import subprocess

import pytest


class SmallDisk:
    """A tmpfs. Mounting it requires root; otherwise the test is skipped.

    Args:
        folder: Mount point.
        size_kb: Initial size.
    """

    def __init__(self, folder, size_kb):
        self.folder = folder
        folder.mkdir(parents=True)
        if os.geteuid() != 0:
            pytest.skip("a small disk (tmpfs) can be mounted by root only")
        done = self._mount("-t", "tmpfs", "-o", f"size={size_kb}k", "tmpfs", str(folder))
        if done.returncode:
            pytest.skip(f"a small disk (tmpfs) cannot be mounted here: {done.stderr.strip()}")

    def _mount(self, *arguments):
        return subprocess.run(["mount", *arguments], capture_output=True, text=True, check=False)

    def fill(self):
        with (self.folder / "ballast").open("wb", buffering=0) as file:
            for size in (65536, 4096):
                try:
                    while True:
                        file.write(b"x" * size)
                except OSError:
                    continue

    def empty(self):
        """Release the space that `fill` uses."""
        (self.folder / "ballast").unlink()

    def grow(self, size_kb):
        done = self._mount("-o", f"remount,size={size_kb}k", str(self.folder))
        assert done.returncode == 0, done.stderr

    @property
    def free_bytes(self):
        return shutil.disk_usage(self.folder).free

    def close(self):
        if self.folder.is_mount():
            subprocess.run(["umount", "--lazy", str(self.folder)], check=True)
