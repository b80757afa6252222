"""Key file of the acoustic link."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Final

from sonarpost.errors import ConfigError
from sonarpost.link.auth.key import AcousticKey, parse_key

_MAX_BYTES: Final = 256


def read_key(path: Path) -> AcousticKey:
    """Read a key file: 64 hexadecimal digits, readable by its owner only.

    Raises:
        ConfigError: It cannot be read, is not a regular file, is accessible to others, or holds no key.
    """
    where = str(path)
    try:
        # Check and read the same descriptor: the file cannot be replaced in between. A pipe must not block.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise ConfigError(where, "acoustic key", error.strerror or str(error), "a readable file") from error
    try:
        _check_owner_only(os.fstat(descriptor), where)
        text = os.read(descriptor, _MAX_BYTES).decode("ascii")
    except OSError as error:
        raise ConfigError(where, "acoustic key", error.strerror or str(error), "a readable file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(where, "key", "other bytes", "64 hexadecimal digits") from error
    finally:
        os.close(descriptor)
    return parse_key(text, where)


def _check_owner_only(status: os.stat_result, where: str) -> None:
    if not stat.S_ISREG(status.st_mode):
        raise ConfigError(where, "acoustic key", stat.filemode(status.st_mode), "a regular file")
    if status.st_mode & 0o077:
        raise ConfigError(where, "mode", f"{stat.S_IMODE(status.st_mode):04o}", "0600, readable by its owner only")
    if status.st_uid not in {os.geteuid(), 0}:
        raise ConfigError(where, "owner", status.st_uid, f"user {os.geteuid()} or root")
