"""Certificate authority: names, files, file modes, rejected requests, and the pki commands."""

import json
import os
import re
import stat
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from cryptography import x509

from sonarpost.cli.main import main
from sonarpost.errors import BadInputError
from sonarpost.security import certificates
from sonarpost.security.fleet import Fleet, FleetIndex, PkiError

DAY_S = 86400.0


@pytest.fixture
def fleet(tmp_path):
    return Fleet.init(tmp_path / "pki", "test")


def mode(path):
    return stat.S_IMODE(path.stat().st_mode)


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o777])
def test_file_modes_are_independent_of_the_umask(tmp_path, umask):
    before = os.umask(umask)
    try:
        fleet = Fleet.init(tmp_path / "pki", "test")
        bundle = fleet.issue("vessel-1", "vessel")
    finally:
        os.umask(before)
    assert mode(fleet.folder) == mode(bundle.folder) == mode(bundle.folder.parent) == 0o700
    private = {"ca.key", "index.json", "key.pem"}
    for path in (*fleet.folder.glob("*.*"), *bundle.folder.iterdir()):
        if path.is_file() and path.name != ".lock":
            assert mode(path) == (0o600 if path.name in private else 0o644), path
    assert mode(fleet.folder / ".lock") & 0o077 == 0


def test_certificate_holds_hosts_and_usage(fleet):
    folder = fleet.issue("shore-1", "shore", ["shore.example", "192.0.2.7", "2001:db8::7"], days=10).folder
    own = x509.load_pem_x509_certificate((folder / "certificate.pem").read_bytes())
    authority = x509.load_pem_x509_certificate((fleet.folder / "ca.pem").read_bytes())
    own.verify_directly_issued_by(authority)
    alternatives = own.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert alternatives.get_values_for_type(x509.DNSName) == ["shore-1", "shore.example"]
    assert [str(a) for a in alternatives.get_values_for_type(x509.IPAddress)] == ["192.0.2.7", "2001:db8::7"]
    assert own.extensions.get_extension_for_class(x509.BasicConstraints).value.ca is False
    constraints = authority.extensions.get_extension_for_class(x509.BasicConstraints).value
    assert (constraints.ca, constraints.path_length) == (True, 0)


def test_revoked_name_is_never_reused(fleet):
    assert fleet.issue("vessel-1", "vessel").entry.common_name == "vessel-1"
    fleet.renew("vessel-1")
    fleet.revoke("vessel-1", "lost")
    assert [e.common_name for e in fleet.index().allowed("vessel")] == []
    second = fleet.issue("vessel-1", "vessel").entry
    assert second.common_name == "vessel-1.g2"
    fleet.revoke("vessel-1", "lost again")
    assert fleet.issue("vessel-1", "vessel").entry.common_name == "vessel-1.g3"
    assert fleet.index().revoked_names() == ["vessel-1", "vessel-1.g2"]
    assert [e.common_name for e in fleet.index().allowed("vessel")] == ["vessel-1.g3"]


def test_renewal_keeps_the_name_with_a_new_key(fleet):
    first, second = fleet.issue("vessel-1", "vessel", ["v.example"]), fleet.renew("vessel-1", days=3)
    assert (second.entry.common_name, second.entry.hosts) == ("vessel-1", ("v.example",))
    assert second.entry.serial != first.entry.serial
    assert (first.folder / "key.pem").read_bytes() != (second.folder / "key.pem").read_bytes()
    assert fleet.renew("vessel-1").folder != second.folder


def test_existing_files_are_not_overwritten(fleet, tmp_path):
    with pytest.raises(PkiError, match="does not exist yet"):
        Fleet.init(fleet.folder, "again")
    fleet.issue("vessel-1", "vessel")
    with pytest.raises(PkiError, match="renew"):
        fleet.issue("vessel-1", "vessel")
    taken = tmp_path / "taken"
    taken.mkdir()
    before = fleet.index()
    with pytest.raises(PkiError, match="taken"):
        fleet.issue("vessel-2", "vessel", out=taken)
    assert fleet.index() == before


def test_certificate_that_cannot_be_written_is_not_indexed(fleet, tmp_path):
    (tmp_path / "file").write_text("")
    before = fleet.index()
    with pytest.raises(OSError, match="file"):
        fleet.issue("vessel-1", "vessel", out=tmp_path / "file" / "below")
    assert fleet.index() == before
    assert fleet.issue("vessel-1", "vessel").entry.common_name == "vessel-1"


def test_invalid_platform_name_or_host_is_rejected(fleet):
    for name in ("shore", "", "Vessel", "vessel.g2", "a" * 33, "-a", "a/b", "../a", "a\n"):
        with pytest.raises(BadInputError, match="platform"):
            fleet.issue(name, "vessel")
    for host in ("a b", "", "-a", "a..b", "1.2.3", "a" * 64, "*.example", "ex_ample", "300.1.1.1"):
        with pytest.raises(BadInputError, match="host"):
            fleet.issue("vessel-1", "vessel", [host])
    assert fleet.index().certificates == ()


def test_common_names_hold_the_generation():
    for name in ("vessel-1", "vessel-1.g2", "v.g999999"):
        assert certificates.common_name(*certificates.platform_of(name)) == name
    for name in ("vessel-1.g1", "vessel-1.g0", "vessel-1.g02", "vessel-1.2", "x.g2.g3", ""):
        with pytest.raises(BadInputError):
            certificates.platform_of(name)


def test_key_can_have_a_passphrase(tmp_path):
    made = Fleet.init(tmp_path / "pki", "test", b"correct horse")
    assert b"ENCRYPTED" in (made.folder / "ca.key").read_bytes()
    assert made.issue("vessel-1", "vessel").entry.common_name == "vessel-1"
    with pytest.raises(BadInputError, match="wrong passphrase") as caught:
        Fleet(made.folder, lambda: b"battery staple").issue("vessel-2", "vessel")
    assert "battery" not in str(caught.value)
    with pytest.raises(PkiError, match="at least 8") as caught:
        Fleet.init(tmp_path / "other", "test", b"short")
    assert "short" not in str(caught.value)


def test_authority_with_a_readable_key_signs_nothing(fleet):
    (fleet.folder / "ca.key").chmod(0o640)
    with pytest.raises(PkiError, match="0640"):
        fleet.issue("vessel-1", "vessel")


def test_authority_signs_only_within_its_validity(tmp_path):
    old = Fleet.init(tmp_path / "pki", "test", days=20, now_utc_s=lambda: time.time() - 10 * DAY_S)
    entry = Fleet(old.folder, lambda: b"").issue("vessel-1", "vessel", days=365).entry
    assert 9 < entry.days_left(time.time()) <= 10
    with pytest.raises(PkiError, match="ended"):
        Fleet(old.folder, lambda: b"", lambda: time.time() + 30 * DAY_S).issue("vessel-2", "vessel")


def test_error_names_the_damaged_index(fleet):
    for text in ("", "{", "[]", '{"v": 2, "fleet": "x"}', '{"v": 1, "fleet": "x", "certificates": [{"serial": "zz"}]}'):
        (fleet.folder / "index.json").write_text(text)
        with pytest.raises(PkiError, match=r"index\.json"):
            FleetIndex.read(fleet.folder)


def test_concurrent_issues_never_reuse_a_name(fleet):
    def issue():
        try:
            return Fleet(fleet.folder, lambda: b"").issue("vessel-1", "vessel").entry.common_name
        except PkiError as error:
            return str(error)

    with ThreadPoolExecutor(4) as pool:
        results = [task.result() for task in [pool.submit(issue) for _ in range(4)]]
    assert results.count("vessel-1") == 1
    assert sum("renew" in text for text in results) == 3
    assert len(fleet.index().certificates) == 1


# Commands


def test_commands_end_to_end(tmp_path, capsys):
    folder, secret = tmp_path / "pki", tmp_path / "secret"
    secret.write_text("correct horse\n")
    secret.chmod(0o600)
    shared = ["--dir", str(folder), "--passphrase-file", str(secret)]
    assert main(["pki", "init", *shared, "--fleet", "north"]) == 0
    assert main(["pki", "issue", "shore-1", "--role", "shore", "--host", "shore.example", *shared]) == 0
    assert main(["pki", "issue", "vessel-1", "--role", "vessel", *shared]) == 0
    assert main(["pki", "renew", "vessel-1", "--days", "5", "--out", str(tmp_path / "new"), *shared]) == 0
    assert (tmp_path / "new" / "key.pem").is_file()
    capsys.readouterr()
    assert main(["pki", "list", "--dir", str(folder)]) == 1
    shown = capsys.readouterr()
    assert "ending" in shown.out
    assert "replaced" in shown.out
    assert "ends soon" in shown.err
    assert main(["pki", "list", "--dir", str(folder), "--warn-days", "1", "--json"]) == 0
    rows = [json.loads(text) for text in capsys.readouterr().out.splitlines()]
    assert [(row["common_name"], row["state"]) for row in rows] == [
        ("shore-1", "valid"),
        ("vessel-1", "replaced"),
        ("vessel-1", "valid"),
    ]
    assert main(["pki", "revoke", "vessel-1", "--reason", "lost", "--dir", str(folder)]) == 0
    assert re.match(r"revoked +vessel-1\nNot in force yet", capsys.readouterr().out)
    out = tmp_path / "router.json5"
    wanted = ["pki", "router-config", "--platform", "shore-1", "--listen", "tls/[::]:7448", "--dir", str(folder)]
    assert main([*wanted, "--out", str(out)]) == 0
    assert "Revoked and denied: vessel-1." in out.read_text()
    assert '"cert_common_names"' not in out.read_text()
    assert main([*wanted, "--out", str(out)]) == 2
    assert main([*wanted, "--out", str(out), "--replace"]) == 0


def test_passphrase_is_read_from_a_private_file_or_a_terminal_only(tmp_path, capsys):
    secret = tmp_path / "secret"
    secret.write_text("correct horse\n")
    secret.chmod(0o644)
    assert main(["pki", "init", "--dir", str(tmp_path / "a"), "--passphrase-file", str(secret)]) == 2
    output = capsys.readouterr().err
    assert "0644" in output
    assert "horse" not in output
    with pytest.raises(SystemExit):
        main(["pki", "init", "--dir", str(tmp_path / "a"), "--passphrase", "correct horse"])
    assert not (tmp_path / "a").exists()


def test_invalid_router_options_are_rejected(fleet, capsys):
    fleet.issue("shore-1", "shore")
    fleet.issue("uuv-1", "uuv")
    for options, words in (
        ("--platform vessel-9", "vessel-9"),
        ("--platform uuv-1", "role"),
        ("--platform shore-1 --listen tcp/0.0.0.0:7448", "tls/HOST:PORT"),
        ("--platform shore-1 --listen tls/0.0.0.0:0", "tls/HOST:PORT"),
        ("--platform shore-1 --local tcp/0.0.0.0:7447", "--open-local"),
        ("--platform shore-1 --connect tcp/shore:7448", "tls/HOST:PORT"),
    ):
        assert main(["pki", "router-config", "--dir", str(fleet.folder), *options.split()]) == 2
        assert words in capsys.readouterr().err
