"""`sonarpost-fleet`, which creates the certificates for the containers."""

import importlib.util
import io
import json
import stat
import sys
import tarfile
from importlib.machinery import SourceFileLoader

import pytest
from builders.common import REPOSITORY

from sonarpost.bus import router
from sonarpost.errors import ConfigError
from sonarpost.link.auth.key import parse_key
from sonarpost.security.fleet import Fleet, FleetIndex, PkiError

FILES = {"ca.pem": 0o644, "certificate.pem": 0o644, "key.pem": 0o600, "router.json5": 0o644}


@pytest.fixture(scope="module")
def script():
    # Its name has no .py: it is a command.
    loader = SourceFileLoader("fleet_script", str(REPOSITORY / "packaging" / "bin" / "sonarpost-fleet"))
    spec = importlib.util.spec_from_loader(loader.name, loader)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def root(tmp_path):
    for name in ("pki", "tls/shore", "tls/vessel", "acoustic/uuv", "acoustic/vessel"):
        (tmp_path / name).mkdir(parents=True)
    return tmp_path


def test_make_writes_the_files_of_both_routers(script, root, capsys):
    assert script.run(["make"], {}, root) == 0
    assert b"ENCRYPTED" not in (root / "pki" / "fleet" / "ca.key").read_bytes()
    assert "its key has no passphrase: keep the volume pki off the hosts that run services" in capsys.readouterr().out
    for platform, listens in (("shore", "shore-1"), ("vessel", "vessel-1")):
        folder = root / "tls" / platform
        assert {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()} == FILES
        config = router.load(folder / "router.json5", [], [], [])
        assert json.loads(config.get_json("metadata"))["platform"] == listens
        assert json.loads(config.get_json("listen/endpoints")) == ["tcp/router:7447", "tls/0.0.0.0:7448"]
        assert json.loads(config.get_json("access_control/default_permission")) == "deny"
    connect = json.loads(
        router.load(root / "tls" / "vessel" / "router.json5", [], [], []).get_json("connect/endpoints")
    )
    assert connect == ["tls/router-shore:7448"]


def key_of(root, platform):
    path = root / "acoustic" / platform / "acoustic.key"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    return path.read_text()


def test_repeated_make_adds_a_platform_and_changes_no_key_and_no_certificate(script, root):
    script.run(["make"], {}, root)
    key = key_of(root, "uuv")
    parse_key(key, "acoustic.key")
    files = [root / "tls" / "vessel" / "certificate.pem", root / "pki" / "fleet" / "ca.key"]
    before = [file.read_bytes() for file in files]
    assert Fleet(root / "pki" / "fleet", lambda: b"").authority_days_left() > 3000
    script.run(["make"], {"FLEET_OBSERVERS": "desk-1"}, root)
    assert [file.read_bytes() for file in files] == before
    assert key_of(root, "uuv") == key_of(root, "vessel") == key
    assert not list((root / "tls" / "shore").glob("acoustic*"))
    assert "desk-1" in (root / "tls" / "shore" / "router.json5").read_text()


def test_make_installs_the_renewed_certificate(script, root):
    script.run(["make"], {}, root)
    before = (root / "tls" / "vessel" / "certificate.pem").read_bytes()
    assert script.run(["pki", "renew", "vessel-1"], {}, root) == 0
    script.run(["make"], {}, root)
    assert (root / "tls" / "vessel" / "certificate.pem").read_bytes() != before


def test_revoked_platform_gets_no_new_certificate(script, root, capsys):
    script.run(["make"], {}, root)
    script.run(["pki", "revoke", "vessel-1"], {}, root)
    script.run(["make"], {}, root)
    assert list((root / "tls" / "vessel").iterdir()) == []
    assert "vessel-1: revoked" in capsys.readouterr().out
    assert '"vessel-1"' not in (root / "tls" / "shore" / "router.json5").read_text()
    with pytest.raises(PkiError, match="a platform with a certificate"):
        script.Depot(root, script.Plan.from_environment({})).files("vessel-1")


def test_bundle_is_installed_on_another_host(script, root, tmp_path_factory, monkeypatch):
    environment = {"FLEET_VESSELS": "vessel-1 vessel-2", "SHORE_HOST": "c2.example", "SHORE_PORT": "9448"}
    script.run(["make"], environment, root)
    archive = script.pack(script.Depot(root, script.Plan.from_environment(environment)).files("vessel-2"))
    aboard = tmp_path_factory.mktemp("aboard")
    (aboard / "tls" / "vessel").mkdir(parents=True)
    monkeypatch.setattr(sys, "stdin", type("In", (), {"buffer": io.BytesIO(archive)}))
    assert script.run(["install"], {}, aboard) == 0
    folder = aboard / "tls" / "vessel"
    assert {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()} == FILES
    config = router.load(folder / "router.json5", [], [], [])
    assert json.loads(config.get_json("connect/endpoints")) == ["tls/c2.example:9448"]
    assert key_of(aboard, "vessel") == (root / "pki" / "fleet" / "acoustic.key").read_text()
    assert not (aboard / "acoustic" / "uuv").exists()
    index = FleetIndex.read(root / "pki" / "fleet")
    shore = index.current("shore-1")
    assert shore.hosts == ("c2.example",)


def test_make_without_folders_for_the_key_writes_none(script, tmp_path):
    for name in ("pki", "tls/shore", "tls/vessel"):
        (tmp_path / name).mkdir(parents=True)
    script.run(["make"], {}, tmp_path)
    assert not (tmp_path / "acoustic").exists()


def test_bundle_of_a_vehicle_holds_the_acoustic_key_only(script, root, tmp_path_factory, monkeypatch):
    environment = {"FLEET_VEHICLES": "uuv-1 uuv-2"}
    script.run(["make"], environment, root)
    depot = script.Depot(root, script.Plan.from_environment(environment))
    files = depot.files("uuv-2")
    assert set(files) == {"acoustic.key"}
    assert set(depot.files("vessel-1")) == {*FILES, "acoustic.key"}
    assert "acoustic.key" not in depot.files("shore-1")
    aboard = tmp_path_factory.mktemp("aboard")
    monkeypatch.setattr(sys, "stdin", type("In", (), {"buffer": io.BytesIO(script.pack(files))}))
    assert script.run(["install"], {}, aboard) == 0
    assert key_of(aboard, "uuv") == key_of(root, "uuv")
    assert not (aboard / "tls").exists()


def tar_of(name, kind=tarfile.REGTYPE):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        entry = tarfile.TarInfo(name)
        entry.type = kind
        archive.addfile(entry)
    return buffer.getvalue()


@pytest.mark.parametrize(
    "data", [b"", b"not a tar", tar_of("../../etc/passwd"), tar_of("key.pem", tarfile.SYMTYPE), tar_of("ca.pem")]
)
def test_invalid_bundle_is_rejected(script, data):
    with pytest.raises(ConfigError, match="bundle"):
        script.unpack(data)


def test_error_names_the_environment_variable(script):
    with pytest.raises(ConfigError, match="SHORE_PORT: got 'x'"):
        script.Plan.from_environment({"SHORE_PORT": "x"})
    with pytest.raises(ConfigError, match="observer: got 'vessel-1', expected a name that no vessel has"):
        script.Plan.from_environment({"FLEET_OBSERVERS": "vessel-1"})
    with pytest.raises(ConfigError, match="vehicle: got 'vessel-1', expected a name that no vessel has"):
        script.Plan.from_environment({"FLEET_VEHICLES": "vessel-1"})


def test_unknown_arguments_show_the_usage(script, root, capsys):
    assert script.run(["mak"], {}, root) == 2
    assert "got 'mak'" in capsys.readouterr().err


def test_make_at_a_terminal_encrypts_the_key_of_the_authority(script, root, monkeypatch, capsys):
    prompts = []
    monkeypatch.setattr(script, "ask_at_terminal", lambda prompt: prompts.append(prompt) or b"correct horse battery")
    assert script.run(["make"], {}, root) == 0
    assert b"ENCRYPTED" in (root / "pki" / "fleet" / "ca.key").read_bytes()
    assert prompts == [
        "Passphrase for the new authority's key, empty for none: ",
        "Repeat: ",
        "Passphrase of the authority's key: ",
    ]
    # Without missing certificates the key is not needed.
    prompts.clear()
    assert script.run(["make"], {}, root) == 0
    assert prompts == []
    assert "no passphrase" not in capsys.readouterr().out
    with pytest.raises(script.SonarpostError):
        script.Depot(root, script.Plan.from_environment({"FLEET_CONSOLES": "c-1"}), lambda _: b"wrong").make()


def test_names_come_from_the_configuration_unless_variables_set_them(script, tmp_path):
    for platform, name in (("uuv", "uuv-5"), ("vessel", "vessel-5"), ("shore", "shore-5")):
        (tmp_path / f"{platform}.toml").write_text(f'[platform]\nid = "{name}"\n')
    environment = {"VESSEL_ID": "vessel-6", "SHORE_ID": "", "FLEET_OBSERVERS": "desk-1"}
    plan = script.Plan.from_environment(script.with_configured_names(environment, tmp_path))
    assert (plan.shore, plan.local_vessel, plan.vehicles) == ("shore-5", "vessel-6", ("uuv-5",))
    assert set(plan.members) == {"shore-5", "vessel-6", "desk-1"}
    assert script.with_configured_names({}, tmp_path / "absent") == {}
    (tmp_path / "uuv.toml").write_text("[platform]\nid = 7\n")
    with pytest.raises(ConfigError, match=r"uuv\.toml:2: platform\.id"):
        script.with_configured_names({}, tmp_path)
