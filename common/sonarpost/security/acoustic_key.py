"""Key file of the acoustic link: creation, and the key that a platform's configuration names."""

import os
import secrets
import stat
from pathlib import Path
from typing import Final

from sonarpost.config import PlatformConfig
from sonarpost.errors import ConfigError
from sonarpost.files import PRIVATE_FILE, open_regular, write_atomically, write_new
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import KEY_BYTES, AcousticKey, parse_key

KEY_NAME: Final = "acoustic.key"
"""Name of the key file in the folder of a fleet."""
UNAUTHENTICATED: Final = 'unauthenticated: acoustic frames are not authenticated (acoustic_auth = "none")'
"""Text in log and health of a service without a key."""

_CREATE: Final = "`sonarpost pki acoustic` creates one"
_MAX_BYTES: Final = 256


def link_key(platform: PlatformConfig) -> AcousticKey | None:
    """Return the key that authenticates a platform's acoustic frames; None with `acoustic_auth = "none"`.

    Raises:
        ConfigError: No key file is named, or as `read_key`.
    """
    if platform.acoustic_auth == "none":
        return None
    if platform.acoustic_key_file is None:
        raise ConfigError(
            "[platform]", "acoustic_key_file", "nothing", f'a key file ({_CREATE}), or acoustic_auth = "none"'
        )
    return read_key(platform.acoustic_key_file)


def key_warning(authenticator: FrameAuthenticator | None) -> str:
    """Return a warning if an authenticator has used 15 of 16 counters of its key; empty otherwise."""
    if authenticator is None or authenticator.frames_left > authenticator.settings.lifetime_frames // 16:
        return ""
    return f"the acoustic key is used up after {authenticator.frames_left} more frames; replace it"


def create_key(path: Path, *, replace: bool = False) -> AcousticKey:
    """Write a new random key to a file that only its owner can read.

    Args:
        path: The file.
        replace: Overwrite an existing file.

    Raises:
        FileExistsError: The file exists, without `replace`.
        OSError: The file cannot be written.
    """
    key = AcousticKey(secrets.token_bytes(KEY_BYTES))
    write = write_atomically if replace else write_new
    write(path, f"{key.secret.hex()}\n".encode(), PRIVATE_FILE)
    return key


def read_key(path: Path) -> AcousticKey:
    """Read a key file: 64 hexadecimal digits, readable by its owner only.

    Raises:
        ConfigError: It cannot be read, is not a regular file, is accessible to others, or holds no key.
    """
    where = str(path)
    try:
        # Check and read the same descriptor: the file cannot be replaced in between.
        descriptor = open_regular(path)
    except OSError as error:
        raise ConfigError(
            where, "acoustic_key_file", error.strerror or str(error), f"a key file ({_CREATE})"
        ) from error
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
    if status.st_mode & 0o077:
        raise ConfigError(where, "mode", f"{stat.S_IMODE(status.st_mode):04o}", "0600, readable by its owner only")
    if status.st_uid not in {os.geteuid(), 0}:
        raise ConfigError(where, "owner", status.st_uid, f"user {os.geteuid()} or root")
