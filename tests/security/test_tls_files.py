"""TLS files of a host: errors are reported at the start, without the content of the files."""

import logging
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from builders.fleet_certificates import tls_of
from cryptography.hazmat.primitives import serialization

from sonarpost import config
from sonarpost.config import ServiceConfig
from sonarpost.errors import ConfigError
from sonarpost.security.fleet import Fleet
from sonarpost.security.tls_files import TlsMonitor, check_tls_files

DAY_S = 86400.0


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    return Fleet.init(tmp_path_factory.mktemp("fleet") / "pki", "test")


@pytest.fixture
def folder(fleet, tmp_path):
    platform = f"vessel-{len(fleet.index().certificates)}"
    return fleet.issue(platform, "vessel", out=tmp_path / "tls").folder


def check(folder, now_utc_s=None):
    return check_tls_files(tls_of(folder), time.time() if now_utc_s is None else now_utc_s)


def test_valid_files_return_the_certificate(folder):
    own = check(folder)
    assert own.common_name.startswith("vessel-")
    assert 364 < own.days_left(time.time()) <= 365
    assert own.warnings == ()


def copy_of_another(name, role):
    """Return a defect: a file of another fleet."""

    def spoil(folder):
        other = Fleet.init(folder / "x", "other")
        source = other.issue("vessel-1", "vessel").folder if role else other.folder
        (folder / name).write_bytes((source / name).read_bytes())

    return spoil


def locked_key(folder):
    key = serialization.load_pem_private_key((folder / "key.pem").read_bytes(), None)
    protection = serialization.BestAvailableEncryption(b"secret words")
    pem = key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, protection)
    (folder / "key.pem").write_bytes(pem)


@pytest.mark.parametrize(
    ("spoil", "where", "words"),
    [
        (lambda folder: (folder / "key.pem").unlink(), "key", "No such file"),
        (lambda folder: (folder / "key.pem").chmod(0o604), "key", "0604"),
        (copy_of_another("key.pem", "vessel"), "key", "another certificate"),
        (copy_of_another("ca.pem", ""), "certificate", "issued by"),
        (lambda folder: shutil.copy(folder / "key.pem", folder / "certificate.pem"), "certificate", "a private key"),
        (lambda folder: (folder / "certificate.pem").write_bytes(b"junk"), "certificate", "PEM certificates"),
        (lambda folder: (folder / "key.pem").write_bytes(b"junk"), "key", "PEM private key"),
        (locked_key, "key", "passphrase"),
    ],
)
def test_error_names_the_file_and_shows_no_part_of_a_key(folder, spoil, where, words):
    secret = (folder / "key.pem").read_text().splitlines()[1]
    spoil(folder)
    with pytest.raises(ConfigError, match=words) as caught:
        check(folder)
    assert caught.value.where == f"platform.tls.{where}"
    assert str(folder) in caught.value.field
    assert secret not in str(caught.value)
    assert secret not in repr(caught.value)


def test_expired_and_future_certificates_are_rejected(folder):
    with pytest.raises(ConfigError, match="expired"):
        check(folder, time.time() + 366 * DAY_S)
    with pytest.raises(ConfigError, match="valid from"):
        check(folder, time.time() - DAY_S)


def test_group_readable_key_gives_a_warning(folder):
    (folder / "key.pem").chmod(0o640)
    assert "0640" in check(folder).warnings[0]


def test_key_given_instead_of_its_path_is_not_shown(folder):
    secret = (folder / "key.pem").read_text()
    with pytest.raises(ConfigError) as caught:
        check_tls_files(tls_of(folder).model_copy(update={"key": Path(secret)}), time.time())
    assert secret.splitlines()[1] not in str(caught.value)


def test_health_reports_soon_expiry_and_expiry(fleet, tmp_path, caplog):
    caplog.set_level(logging.WARNING)
    folder = fleet.issue("vessel-90", "vessel", days=10, out=tmp_path / "tls").folder
    own, now_utc_s = TlsMonitor(tls_of(folder)), time.time()
    assert "Certificate expires soon" in caplog.text
    assert "ends in 10.0 days" in own.warning(now_utc_s)
    assert own.degraded_reason(now_utc_s) == ""
    assert own.warning(now_utc_s + 11 * DAY_S) == ""
    assert "has expired" in own.degraded_reason(now_utc_s + 11 * DAY_S)
    assert own.gauges(now_utc_s)["certificate_days_left"] == pytest.approx(10, abs=0.01)
    late = TlsMonitor(tls_of(folder).model_copy(update={"warn_days": 5.0}))
    assert late.warning(now_utc_s) == ""
    nothing = TlsMonitor(None)
    assert (nothing.warning(now_utc_s), nothing.degraded_reason(now_utc_s), nothing.gauges(now_utc_s)) == ("", "", {})


# Configuration


def load(tmp_path, text, **environment):
    path = tmp_path / "vessel.toml"
    path.write_text(text)
    return config.load(path, "relay", ServiceConfig, environment)[0]


FILES = 'tls = { ca = "a.pem", certificate = "b.pem", key = "c.pem" }'


def test_platform_table_names_the_files_and_the_environment_overrides_each_or_all(tmp_path):
    table = '[platform]\nid = "vessel-1"\n'
    platform = load(tmp_path, f'{table}upstream = ["tls/shore:7448"]\n{FILES}\n')
    assert platform.upstream == ("tls/shore:7448",)
    assert load(tmp_path, table).tls is None
    three = {f"SONARPOST_PLATFORM__TLS__{name}": f"/{name}" for name in ("CA", "CERTIFICATE", "KEY")}
    whole = {"SONARPOST_PLATFORM__TLS": '{ ca = "x", certificate = "y", key = "z" }'}
    for made, expected in (
        (platform, "a.pem b.pem c.pem"),
        (load(tmp_path, f"{table}{FILES}\n", SONARPOST_PLATFORM__TLS__KEY="/run/key"), "a.pem b.pem /run/key"),
        (load(tmp_path, table, **three), "/CA /CERTIFICATE /KEY"),
        (load(tmp_path, f"{table}{FILES}\n", **whole), "x y z"),
    ):
        assert [str(path) for path in (made.tls.ca, made.tls.certificate, made.tls.key)] == expected.split()


@pytest.mark.parametrize(
    ("text", "environment", "field"),
    [
        ('tls = { ca = "a" }', {}, "platform.tls.certificate"),
        ('tls = { ca = "a", certificate = "b", key = "c", kee = "d" }', {}, "platform.tls.kee"),
        ('tls = "a"', {}, "platform.tls"),
        (FILES, {"SONARPOST_PLATFORM__TLS__KEE": "x"}, "SONARPOST_PLATFORM__TLS__KEE"),
        (FILES, {"SONARPOST_PLATFORM__TLS": "x"}, "SONARPOST_PLATFORM__TLS"),
    ],
)
def test_error_names_the_configuration_key(tmp_path, text, environment, field):
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, f'[platform]\nid = "vessel-1"\n{text}\n', **environment)
    assert caught.value.field == field


def test_service_with_invalid_files_exits_with_one_line(tmp_path, folder):
    (folder / "key.pem").chmod(0o644)
    path = tmp_path / "vessel.toml"
    names = {"ca": "ca.pem", "certificate": "certificate.pem", "key": "key.pem"}
    files = ", ".join(f'{name} = "{folder / file}"' for name, file in names.items())
    path.write_text(f'[platform]\nid = "vessel-1"\nstate_dir = "{tmp_path}"\ntls = {{ {files} }}\n')
    done = subprocess.run(
        [sys.executable, "-m", "sonarpost.services.relay", "--config", str(path)],
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "platform.tls.key" in done.stderr
    assert "0644" in done.stderr
    assert (folder / "key.pem").read_text().splitlines()[1] not in done.stderr + done.stdout
