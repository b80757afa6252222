"""`sonarpost config`: examples from the package, and a check that reports every error."""

import importlib.util
import os
import re

import pytest
from builders.common import REPOSITORY

from sonarpost.cli.deployment import config_files
from sonarpost.cli.main import main
from sonarpost.security.acoustic_key import create_key
from sonarpost.security.fleet import Fleet


@pytest.fixture(autouse=True)
def _no_overrides(monkeypatch):
    for name in [name for name in os.environ if name.startswith("SONARPOST_")]:
        monkeypatch.delenv(name)


def example(tmp_path, name):
    """Write an example whose folders are in `tmp_path`, and the acoustic key that it names."""
    path = tmp_path / f"{name}.toml"
    path.write_text(config_files.example_files()[name].read_text().replace("/var/lib/sonarpost", str(tmp_path)))
    (tmp_path / "acoustic").mkdir(exist_ok=True)
    create_key(tmp_path / "acoustic" / "acoustic.key", replace=True)
    return path


def check(path, capsys):
    """Run `config check`; return status, lines of standard output, lines of standard error."""
    status = main(["config", "check", str(path)])
    captured = capsys.readouterr()
    return status, captured.out.splitlines(), captured.err.splitlines()


def test_every_shipped_configuration_is_printed_unchanged(capsys):
    for path in (REPOSITORY / "config").iterdir():
        assert main(["config", "example", path.stem]) == 0
        assert capsys.readouterr().out == path.read_text(encoding="utf-8")


def test_an_example_is_written_once_readable_for_the_services(tmp_path, capsys):
    path = tmp_path / "etc" / "vessel.toml"
    before = os.umask(0o077)
    try:
        assert main(["config", "example", "vessel", "--out", str(path)]) == 0
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == 0o644
    path.write_text("# edited\n")
    assert main(["config", "example", "vessel", "--out", str(path)]) == 2
    assert "got 'an existing file', expected a new file, or --force" in capsys.readouterr().err
    assert path.read_text() == "# edited\n"
    assert main(["config", "example", "vessel", "--out", str(path), "--force"]) == 0
    assert "[op_modem]" in path.read_text()


def test_examples_are_valid_with_a_line_for_each_service(tmp_path, capsys):
    for name, services in {
        "uuv": ["atd_stub", "compressor", "uuv_modem"],
        "vessel": ["op_modem", "decompressor", "relay", "console"],
        "shore": ["c2", "console"],
    }.items():
        status, out, _ = check(example(tmp_path, name), capsys)
        assert status == 0
        assert [line.partition(":")[0] for line in out[1:]] == [f"[{service}]" for service in services]
        assert re.search(r"valid, platform \S+, router tcp/127.0.0.1:7447$", out[0])


def test_an_absent_serial_device_is_a_warning(tmp_path, capsys):
    path = example(tmp_path, "vessel")
    path.write_text(path.read_text().replace("/dev/ttyUSB0", str(tmp_path / "ttyUSB7")))
    line = path.read_text().splitlines().index(f'port = "{tmp_path}/ttyUSB7"') + 1
    status, _, err = check(path, capsys)
    assert (status, len(err)) == (0, 1)
    assert err[0].startswith(f"{path}:{line}: op_modem.port: got ")
    assert err[0].endswith("this one is absent now (warning)")


def test_all_errors_of_all_tables_are_reported(tmp_path, capsys, monkeypatch):
    path = tmp_path / "bad.toml"
    path.write_text(
        '[platform]\nid = "Vessel 1"\nnaem = 3\n[op_modem]\nport = "/dev/null"\naddress = 300\nframe_s = 3\n'
        '[relais]\n[decompressor]\nout_dir = 3\n[c2]\nsite = "shore"\n'
    )
    monkeypatch.setenv("SONARPOST_DECOMPRESSOR__MAX_BYTES", "many")
    monkeypatch.setenv("SONARPOST_RELAIS__X", "1")
    status, out, err = check(path, capsys)
    assert (status, out) == (2, [])
    assert err[-1] == f"{path}: 8 errors"
    found = {re.sub(r": got .*", "", line) for line in err[:-1]}
    assert found == {
        f"{path}:2: platform.id",
        f"{path}:3: platform.naem",
        f"{path}:6: op_modem.address",
        f"{path}:7: op_modem.frame_s",
        f"{path}:8: relais",
        f"{path}:10: decompressor.out_dir",
        "environment: SONARPOST_DECOMPRESSOR__MAX_BYTES",
        "environment: SONARPOST_RELAIS__X",
    }


TLS = 'tls = { ca = "ca.pem", certificate = "c.pem", key = "k.pem" }'


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "acoustic.key",
            "absent.key",
            "platform.acoustic_key_file: {folder}/acoustic/absent.key: got 'No such",
        ),
        ('link = "v1"', 'link = "paper"', "uuv_modem.link: got 'paper'"),
        ('codec = "emb"', 'codec = "spith"', "compressor.codec: got 'spith', expected one of"),
        ('model = "standard"', 'model = "small"', "compressor.model: got 'small', expected standard or structure"),
        ("/dev/ttyUSB0", "carrier://pigeon", "uuv_modem.port: got 'carrier://pigeon 19200', expected a device path"),
        ("tcp/127.0.0.1", "tls/127.0.0.1", "platform.tls: got 'nothing'"),
        ('id = "uuv-1"', f'id = "uuv-1"\n{TLS}', "platform.tls."),
        ("", "", "platform.acoustic_key_file: {folder}/acoustic/acoustic.key: got '0644', expected 0600"),
    ],
)
def test_values_that_a_service_would_refuse_at_its_start_are_located(old, new, expected, tmp_path, capsys):
    path = example(tmp_path, "uuv")
    path.write_text(path.read_text().replace(old, new) if old else path.read_text())
    (tmp_path / "acoustic" / "acoustic.key").chmod(0o600 if old else 0o644)
    status, _, err = check(path, capsys)
    assert status == 2
    [line] = [line for line in err if "(warning)" not in line and not line.endswith(": 1 error")]
    assert re.match(rf"{re.escape(str(path))}:\d+: {re.escape(expected.format(folder=tmp_path))}", line), line


def test_an_absent_codebook_is_an_error(tmp_path, capsys):
    path = example(tmp_path, "vessel")
    path.write_text(path.read_text().replace('"nominal-20"', f'"{tmp_path}/own.tiles"'))
    status, _, err = check(path, capsys)
    assert status == 2
    assert any(line.startswith(f"{tmp_path}/own.tiles: ") for line in err)


def test_a_console_without_its_extra_is_an_error(tmp_path, capsys, monkeypatch):
    path = example(tmp_path, "shore")
    found = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "uvicorn" else found(name))
    line = path.read_text().splitlines().index("[console]") + 1
    status, _, err = check(path, capsys)
    assert (status, len(err)) == (2, 2)
    assert err[0].startswith(f"{path}:{line}: console: got 'no web server installed', expected the extra console: pip")


def test_an_invalid_file_of_survey_options_hides_no_other_error(tmp_path, capsys):
    path = example(tmp_path, "uuv")
    text = path.read_text().replace("[atd_stub]", f'[atd_stub]\nsurvey_options = "{tmp_path}/absent.toml"')
    path.write_text(text.replace('codec = "emb"', "codec = 3"))
    status, _, err = check(path, capsys)
    assert (status, err[-1]) == (2, f"{path}: 2 errors")
    assert any(line.startswith(f"{tmp_path}/absent.toml: ") for line in err)
    assert any("compressor.codec: got 3" in line for line in err)


def test_certificates_of_a_fleet_are_valid(tmp_path, capsys):
    folder = Fleet.init(tmp_path / "pki", "test").issue("vessel-1", "vessel").folder
    path = example(tmp_path, "vessel")
    tls = f'tls = {{ ca = "{folder}/ca.pem", certificate = "{folder}/certificate.pem", key = "{folder}/key.pem" }}'
    text = path.read_text().replace("tcp/127.0.0.1", "tls/127.0.0.1").replace("[platform]", f"[platform]\n{tls}")
    path.write_text(text)
    assert check(path, capsys)[0] == 0


def test_a_service_of_a_plug_in_that_cannot_be_imported_is_named(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(config_files, "service_packages", lambda: {"c2": "package_that_is_absent"})
    status, _, errors = check(example(tmp_path, "shore"), capsys)
    assert status == 2
    assert errors[-1].startswith("sonarpost: entry point sonarpost.services:c2: value: got ")


def test_a_file_without_a_service_and_an_unreadable_file_are_errors(tmp_path, capsys):
    path = tmp_path / "empty.toml"
    path.write_text('[platform]\nid = "uuv-1"\n')
    assert "no table of a service" in check(path, capsys)[2][0]
    assert "a readable TOML file" in check(tmp_path / "absent.toml", capsys)[2][0]
    path.write_text("[platform\n")
    status, _, err = check(path, capsys)
    assert (status, len(err)) == (2, 1)
    assert "valid TOML" in err[0]
