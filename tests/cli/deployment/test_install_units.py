"""`sonarpost install-units`: files, what it refuses to replace, and systemd's own verification."""

import os
import re
import shutil
import subprocess
import sys

import pytest

from sonarpost.cli.deployment.config_files import PLATFORMS
from sonarpost.cli.main import main

SERVICES = {
    "uuv": ["atd_stub", "compressor", "uuv_modem"],
    "vessel": ["op_modem", "decompressor", "relay", "console"],
    "shore": ["c2", "console"],
}


@pytest.fixture
def root(tmp_path):
    """Return a root of a file system with an installed command."""
    command = tmp_path / "root" / "opt" / "sonarpost" / "bin" / "sonarpost"
    command.parent.mkdir(parents=True)
    command.write_text("#!/bin/sh\n")
    command.chmod(0o755)
    return tmp_path / "root"


def install(root, platform, *options, executable="/opt/sonarpost/bin/sonarpost"):
    return main(["install-units", platform, "--root", str(root), "--executable", executable, *options])


def units(root):
    return root / "etc" / "systemd" / "system"


def settings(path, key):
    return re.findall(rf"^{key}=(.*)$", path.read_text(), re.MULTILINE)


def test_the_target_starts_the_router_and_the_services_of_the_platform(root, capsys):
    for platform in PLATFORMS:
        assert install(root, platform, "--force") == 0
        wanted = settings(units(root) / f"sonarpost-{platform}.target", "Wants")[0].split()
        expected = ["sonarpost-router.service", *(f"sonarpost@{name}.service" for name in SERVICES[platform])]
        assert wanted == expected
        assert f"systemctl enable --now sonarpost-{platform}.target" in capsys.readouterr().out


def test_the_tables_of_an_existing_configuration_select_the_services(root):
    (root / "etc" / "sonarpost").mkdir(parents=True)
    (root / "etc" / "sonarpost" / "vessel.toml").write_text('[platform]\nid = "v"\n[relay]\n[op_modem]\n')
    assert install(root, "vessel") == 0
    wanted = settings(units(root) / "sonarpost-vessel.target", "Wants")
    assert wanted == ["sonarpost-router.service sonarpost@op_modem.service sonarpost@relay.service"]
    assert not (units(root) / "sonarpost@decompressor.service.d").exists()


def test_paths_and_user_are_in_the_units(root, capsys):
    odd = root / "opt" / "a b%c$d" / "sonarpost"
    odd.parent.mkdir()
    shutil.copy(root / "opt" / "sonarpost" / "bin" / "sonarpost", odd)
    options = ("--config", "/etc/own/a.toml", "--router-config", "/etc/own/r.json5", "--user", "sonar")
    assert install(root, "vessel", *options, executable="/opt/a b%c$d/sonarpost") == 0
    template, router = units(root) / "sonarpost@.service", units(root) / "sonarpost-router.service"
    assert settings(template, "ExecStart") == ['"/opt/a b%%c$$d/sonarpost" run %i --config /etc/own/a.toml']
    assert settings(router, "ExecStart") == ['"/opt/a b%%c$$d/sonarpost" router --config /etc/own/r.json5']
    assert [settings(path, "User") for path in (template, router)] == [["sonar"], ["sonar"]]
    assert "u sonar - " in (root / "etc" / "sysusers.d" / "sonarpost.conf").read_text()
    assert "runuser -u sonar -- '/opt/a b%c$d/sonarpost' config check /etc/own/a.toml" in capsys.readouterr().out
    for path in (root / "etc").rglob("*.*"):
        if path.is_file():
            assert not re.search(r"@[A-Z_]+@", path.read_text()), path
            assert path.stat().st_mode & 0o777 == 0o644


def test_a_second_installation_changes_nothing_but_files_of_another_version(root, capsys):
    install(root, "uuv")
    assert ": unchanged" not in capsys.readouterr().out
    assert install(root, "uuv") == 0
    assert ": written" not in capsys.readouterr().out
    assert install(root, "uuv", "--user", "other") == 0
    assert settings(units(root) / "sonarpost@.service", "User") == ["other"]


def test_an_edited_file_is_kept_without_force(root, capsys):
    install(root, "uuv")
    template, router = units(root) / "sonarpost@.service", units(root) / "sonarpost-router.service"
    edited = template.read_text().replace("WatchdogSec=60", "WatchdogSec=90")
    template.write_text(edited)
    router.write_text("[Service]\n")
    assert install(root, "uuv", "--user", "other") == 2
    error = capsys.readouterr().err
    assert all(text in error for text in (str(template), str(router), "systemctl edit"))
    assert template.read_text() == edited
    assert "other" not in (root / "etc" / "sysusers.d" / "sonarpost.conf").read_text()  # nothing was written
    assert install(root, "uuv", "--user", "other", "--force") == 0
    assert settings(template, "WatchdogSec") == ["60"]


def test_units_of_another_platform_are_refused(root, capsys):
    install(root, "uuv")
    assert install(root, "vessel") == 2
    assert "got 'units of the platform uuv'" in capsys.readouterr().err
    assert not (units(root) / "sonarpost-vessel.target").exists()


def test_dry_run_prints_the_files_and_writes_none(root, capsys):
    assert install(root, "vessel", "--dry-run") == 0
    out = capsys.readouterr().out
    assert f"==> {units(root)}/sonarpost@.service\n" in out
    assert "RestartPreventExitStatus=2" in out
    assert not (root / "etc").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--user", "a b"], "--user: got 'a b'"),
        (
            ["--config", "/home/anna/vessel.toml"],
            "--config: got '/home/anna/vessel.toml', expected a path that services",
        ),
        (["--executable", "/root/.venv/bin/sonarpost"], "--executable: got '/root/.venv/bin/sonarpost'"),
        (["--executable", "/opt/absent"], "opt/absent', expected the path of the sonarpost command"),
    ],
)
def test_values_with_which_no_service_would_start_are_refused(options, message, root, capsys):
    assert install(root, "vessel", *options) == 2
    assert message in capsys.readouterr().err
    assert not (root / "etc").exists()


def test_the_running_command_is_the_default(root, monkeypatch, capsys):
    command = root / "opt" / "sonarpost" / "bin" / "sonarpost"
    monkeypatch.setattr(sys, "argv", [str(command)])
    monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
    assert main(["install-units", "shore", "--root", str(root)]) == 0
    assert settings(units(root) / "sonarpost@.service", "ExecStart")[0].split()[0] == str(command)
    monkeypatch.setattr(sys, "executable", "/root/python3")  # an environment in /opt with a Python in a home folder
    assert main(["install-units", "shore", "--root", str(root)]) == 2
    assert "got '/root/python3'" in capsys.readouterr().err


needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is absent: install the Debian package systemd"
)


def analyze(root, *arguments):
    # The colon at the end adds systemd's own folders, for targets such as multi-user.target.
    environment = {**os.environ, "SYSTEMD_UNIT_PATH": f"{units(root)}:", "SYSTEMD_COLORS": "0"}
    return subprocess.run(["systemd-analyze", *arguments], env=environment, capture_output=True, text=True, check=False)


@pytest.fixture
def real_root(tmp_path):
    """Return a root whose command exists outside of it, for systemd's check of ExecStart."""
    shutil.copy("/bin/true", tmp_path / "sonarpost")
    seen_in_root = tmp_path / "root" / (tmp_path / "sonarpost").relative_to("/")
    seen_in_root.parent.mkdir(parents=True)
    shutil.copy("/bin/true", seen_in_root)
    return tmp_path / "root"


@needs_systemd
@pytest.mark.parametrize("platform", PLATFORMS)
def test_systemd_accepts_every_unit_and_its_exposure_is_low(platform, real_root, tmp_path):
    assert install(real_root, platform, executable=str(tmp_path / "sonarpost")) == 0
    names = ["sonarpost-router.service", *(f"sonarpost@{service}.service" for service in SERVICES[platform])]
    result = analyze(real_root, "verify", f"sonarpost-{platform}.target", *names)
    assert (result.returncode, result.stderr, result.stdout) == (0, "", "")
    for name in names:
        result = analyze(real_root, "security", "--offline=true", "--threshold=30", name)
        # systemd: 0 to 10; the threshold is ten times that.
        assert result.returncode == 0, result.stdout[-300:]


@needs_systemd
def test_systemd_reports_an_unknown_key(real_root, tmp_path):
    """The check above would fail for a misspelled setting."""
    install(real_root, "shore", executable=str(tmp_path / "sonarpost"))
    path = units(real_root) / "sonarpost@.service"
    path.write_text(path.read_text().replace("ProtectHome", "ProtectHomes"))
    assert "Unknown key" in analyze(real_root, "verify", "sonarpost@c2.service").stderr
