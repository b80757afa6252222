"""TLS files of a client: PEM and PKCS#12, encrypted keys."""

import pytest
from builders.tls_authority import Authority

from sonarpost.errors import ConfigError
from sonarpost.security.client_tls import TlsFiles

PASSPHRASE = b"atakatak"


@pytest.fixture
def authority(tmp_path):
    return Authority(tmp_path)


def test_encrypted_key_and_pkcs12_have_the_certificates(authority, tmp_path):
    files = authority.issue("client")
    client, truststore, key = authority.encrypted(files, PASSPHRASE)
    passphrase = tmp_path / "passphrase"
    passphrase.write_bytes(PASSPHRASE + b"\nmore")
    passphrase.chmod(0o600)
    for tls in (
        files,
        TlsFiles(files.ca, files.certificate, key, passphrase),
        TlsFiles(files.ca, client, None, passphrase),
        TlsFiles(truststore, client, None, passphrase),
    ):
        assert len(tls.context().get_ca_certs()) == 1


def test_invalid_files_are_errors_without_secrets(authority, tmp_path):
    files = authority.issue("client")
    client, truststore, key = authority.encrypted(files, PASSPHRASE)
    wrong, readable = tmp_path / "wrong", tmp_path / "readable"
    wrong.write_bytes(b"secret of another key")
    wrong.chmod(0o600)
    readable.write_bytes(PASSPHRASE)
    readable.chmod(0o644)
    bad = tmp_path / "bad.pem"
    bad.write_text("no certificate")
    for tls, text in (
        (TlsFiles(files.ca, files.certificate, key), "key-locked.pem.*an encrypted key'.*the passphrase file"),
        (TlsFiles(files.ca, files.certificate, key, wrong), "key-locked.pem.*an encrypted key'.*the passphrase file"),
        (TlsFiles(files.ca, client), "client.p12.*an encrypted or damaged file.*the passphrase file"),
        (TlsFiles(files.ca, client, None, wrong), "client.p12.*an encrypted or damaged file"),
        (TlsFiles(files.ca, files.certificate, key, readable), "readable: mode: got '0644', expected 0600"),
        (TlsFiles(files.ca, files.certificate, key, tmp_path / "none"), "none.*a readable file"),
        (TlsFiles(files.ca, truststore, None, wrong), "truststore.p12.*an encrypted or damaged file"),
        (TlsFiles(tmp_path / "nowhere.pem"), "TLS: files: got .*nowhere.pem.*expected readable PEM files"),
        (TlsFiles(bad), "bad.pem"),
        (TlsFiles(bad.with_suffix(".p12")), "bad.p12"),
    ):
        with pytest.raises(ConfigError, match=f"(?s){text}") as caught:
            tls.context()
        assert "secret of" not in str(caught.value)
    readable.chmod(0o600)
    with pytest.raises(ConfigError, match=r"truststore.p12.*readable PEM files"):
        TlsFiles(files.ca, truststore, None, readable).context()
