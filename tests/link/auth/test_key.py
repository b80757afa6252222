"""Key files of the acoustic link."""

import os
from pathlib import Path

import pytest
from builders.authentication_world import key

from sonarpost.errors import ConfigError
from sonarpost.link.auth.key import AcousticKey, AuthenticationSettings, Direction, parse_key
from sonarpost.security.acoustic_key import read_key

SECRET = bytes(range(100, 132))


def write(path: Path, text: str, mode: int = 0o600) -> Path:
    path.write_text(text, encoding="utf-8")
    path.chmod(mode)
    return path


def test_key_file_is_read(tmp_path: Path) -> None:
    for text in (SECRET.hex(), SECRET.hex().upper() + "\n", f"  {SECRET.hex()}\r\n"):
        assert read_key(write(tmp_path / "acoustic.key", text)) == AcousticKey(SECRET)
    assert read_key(write(tmp_path / "read-only.key", SECRET.hex(), 0o400)) == AcousticKey(SECRET)


@pytest.mark.parametrize(
    "text", ["", SECRET.hex()[:-1], SECRET.hex() + "00", "g" * 64, "0" * 64, "0123456789abcdef" * 4, "\u0663" * 64]
)
def test_invalid_key_is_rejected_without_its_content(tmp_path: Path, text: str) -> None:
    path = write(tmp_path / "acoustic.key", text)
    with pytest.raises(ConfigError, match="key") as caught:
        read_key(path)
    assert caught.value.where == str(path)
    assert not text or text not in str(caught.value)


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o620, 0o601])
def test_key_file_with_wide_permissions_is_rejected(tmp_path: Path, mode: int) -> None:
    with pytest.raises(ConfigError, match="0600") as caught:
        read_key(write(tmp_path / "acoustic.key", SECRET.hex(), mode))
    assert caught.value.value == f"{mode:04o}"


def test_path_without_a_regular_file_is_rejected(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe", 0o600)
    for path in (tmp_path / "missing", tmp_path, tmp_path / "pipe"):
        with pytest.raises(ConfigError, match="acoustic"):
            read_key(path)


def test_key_is_not_printed_and_has_a_fingerprint() -> None:
    one = parse_key(SECRET.hex(), "here")
    assert SECRET.hex() not in repr(one)
    assert repr(SECRET) not in repr(one)
    assert len(one.fingerprint) == 8
    assert one.fingerprint == AcousticKey(SECRET).fingerprint != key("another").fingerprint
    for length in (0, 31, 33):
        with pytest.raises(ConfigError, match="32 bytes"):
            AcousticKey(bytes(length))


def test_each_combination_of_settings_has_its_own_key() -> None:
    one = AcousticKey(SECRET)
    made = {
        one.cipher(source, direction, AuthenticationSettings(counter, 8, encrypt)).encrypt(bytes(13), b"", b"same")
        for source in range(128)
        for direction in Direction
        for counter in (1, 2)
        for encrypt in (False, True)
    }
    assert len(made) == 128 * 8
