"""`sonarpost pki acoustic`, and the key that a platform's configuration names."""

import stat

import pytest

from sonarpost.cli.main import main
from sonarpost.config import PlatformConfig
from sonarpost.errors import ConfigError
from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, Direction
from sonarpost.security.acoustic_key import key_warning, link_key, read_key


def test_command_creates_a_private_key_and_prints_its_fingerprint_only(tmp_path, capsys):
    folder = tmp_path / "fleet"
    assert main(["pki", "init", "--dir", str(folder)]) == 0
    assert main(["pki", "acoustic", "--dir", str(folder)]) == 0
    path = folder / "acoustic.key"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    key, output = read_key(path), capsys.readouterr().out
    assert key.fingerprint in output
    assert str(path) in output
    assert key.secret.hex() not in output


def test_each_key_is_another_one_and_none_is_overwritten(tmp_path, capsys):
    one, two = tmp_path / "one.key", tmp_path / "two.key"
    assert main(["pki", "acoustic", "--out", str(one)]) == 0
    assert main(["pki", "acoustic", "--out", str(two)]) == 0
    before = read_key(one)
    assert before != read_key(two)
    assert main(["pki", "acoustic", "--out", str(one)]) == 2
    assert "an existing key" in capsys.readouterr().err
    assert read_key(one) == before
    assert main(["pki", "acoustic", "--out", str(one), "--replace"]) == 0
    assert read_key(one) != before
    assert stat.S_IMODE(one.stat().st_mode) == 0o600


def test_missing_folder_is_named(tmp_path, capsys):
    assert main(["pki", "acoustic", "--dir", str(tmp_path / "fleet")]) == 2
    assert "sonarpost pki init" in capsys.readouterr().err


def test_authentication_is_on_unless_it_is_switched_off(tmp_path):
    path = tmp_path / "acoustic.key"
    assert main(["pki", "acoustic", "--out", str(path)]) == 0
    assert link_key(PlatformConfig(id="uuv-1", acoustic_key_file=path)) == read_key(path)
    with pytest.raises(ConfigError, match="acoustic_key_file"):
        link_key(PlatformConfig(id="uuv-1"))
    assert link_key(PlatformConfig(id="uuv-1", acoustic_auth="none")) is None
    # A named file is not read: one environment variable switches authentication off.
    assert link_key(PlatformConfig(id="uuv-1", acoustic_auth="none", acoustic_key_file=tmp_path / "absent")) is None
    with pytest.raises(ValueError, match="acoustic_auth"):
        PlatformConfig.model_validate({"id": "uuv-1", "acoustic_auth": "off"})


def test_warning_when_the_last_sixteenth_of_the_key_is_in_use():
    key = AcousticKey(bytes(range(32)))
    fresh = FrameAuthenticator(key, 3, Direction.FROM_VEHICLE, first_counter=1_000_000 - 20_000)
    assert key_warning(fresh) == key_warning(None) == ""
    used = FrameAuthenticator(key, 3, Direction.FROM_VEHICLE, first_counter=(1 << 20) - 500)
    assert "500 more frames" in key_warning(used)
