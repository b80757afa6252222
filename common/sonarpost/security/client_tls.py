"""TLS of a client of another program: certificates and keys in PEM or PKCS#12 files."""

import ssl
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.serialization import BestAvailableEncryption, Encoding, PrivateFormat, pkcs12

from sonarpost.config import read_passphrase
from sonarpost.errors import ConfigError

_PKCS12: Final = (".p12", ".pfx")
_NO_PASSPHRASE: Final = b"-"


@dataclass(frozen=True, slots=True)
class TlsFiles:
    """Files of a TLS client: PEM, or PKCS#12 with a name that ends in .p12 or .pfx.

    Attributes:
        ca: Trusted certificate authorities; None trusts those of the operating system.
        certificate: Client certificate, if the server requires one; a PKCS#12 file holds its key as well.
        key: Private key of a PEM certificate.
        passphrase_file: Passphrase of the key and of PKCS#12 files in its first line, readable by its owner only.
        server_name: Name in the server's certificate; None for the host of its address.
    """

    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    passphrase_file: Path | None = None
    server_name: str | None = None

    def context(self) -> ssl.SSLContext:
        """Return a TLS context that verifies the server's certificate and its name.

        Raises:
            ConfigError: A file is missing or has another format, a key is encrypted and its passphrase missing or
                wrong, or others can read the passphrase. The message holds no secret.
        """
        passphrase = None if self.passphrase_file is None else read_passphrase(self.passphrase_file)
        asked: list[bool] = []

        def give_passphrase() -> bytes:
            asked.append(True)  # OpenSSL asks for that of an encrypted key only
            return passphrase or b""

        try:
            if self.ca is not None and self.ca.suffix in _PKCS12:
                context = ssl.create_default_context(cadata=_pem_of(self.ca, passphrase).decode() or "no certificate")
            else:
                context = ssl.create_default_context(cafile=self.ca)
            if self.certificate is not None and self.certificate.suffix in _PKCS12:
                with tempfile.NamedTemporaryFile() as file:  # OpenSSL reads files only; the key in it is encrypted
                    file.write(_pem_of(self.certificate, passphrase))
                    file.flush()
                    context.load_cert_chain(file.name, password=passphrase or _NO_PASSPHRASE)
            elif self.certificate is not None:
                context.load_cert_chain(self.certificate, self.key, give_passphrase)
        except OSError as error:  # includes ssl.SSLError
            if asked:
                raise _encrypted(self.key or self.certificate, "an encrypted key") from error
            files = ", ".join(str(p) for p in (self.ca, self.certificate, self.key) if p is not None)
            raise ConfigError("TLS", "files", files, f"readable PEM files ({error})") from error
        context.minimum_version = ssl.TLSVersion.TLSv1_2
        return context


def _encrypted(path: Path | None, got: str) -> ConfigError:
    return ConfigError(str(path), "TLS", got, "no passphrase, or its passphrase in the passphrase file")


def _pem_of(path: Path, passphrase: bytes | None) -> bytes:
    """Return the certificates and the key of a PKCS#12 file; the key is encrypted with the same passphrase."""
    try:
        content = pkcs12.load_pkcs12(path.read_bytes(), passphrase)
    except (ValueError, UnsupportedAlgorithm) as error:
        raise _encrypted(path, f"an encrypted or damaged file ({error})") from error
    lock = BestAvailableEncryption(passphrase or _NO_PASSPHRASE)
    found = [entry for entry in (content.cert, *content.additional_certs) if entry is not None]
    key = b"" if content.key is None else content.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, lock)
    return key + b"".join(entry.certificate.public_bytes(Encoding.PEM) for entry in found)
