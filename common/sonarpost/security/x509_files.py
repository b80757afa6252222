"""Keys and certificates by the library `cryptography`: EC P-256, SHA-256, PEM. Files are not touched here."""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from sonarpost.errors import BadInputError

# Clocks at sea differ; a certificate that begins a little early is taken by a host whose clock is behind.
CLOCK_SKEW = timedelta(minutes=10)
_HOST_LABEL = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?")


@dataclass(frozen=True, slots=True)
class Authority:
    """A fleet's certificate authority, ready to sign."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


@dataclass(frozen=True, slots=True)
class Signed:
    """A new certificate and its private key, as PEM."""

    certificate: x509.Certificate
    certificate_pem: bytes
    key_pem: bytes

    @property
    def serial(self) -> str:
        """Serial number, hexadecimal."""
        return f"{self.certificate.serial_number:x}"


def new_authority(fleet: str, days: int, now: datetime, passphrase: bytes | None) -> tuple[Authority, bytes, bytes]:
    """Make a self-signed authority that may sign platforms' certificates and no further authority.

    Args:
        fleet: Name of the fleet, for people.
        days: Validity in days.
        now: Begin of validity, aware.
        passphrase: Protects the key's file, None for a key in the clear.

    Returns:
        The authority, its certificate's PEM, its key's PEM.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, "sonarpost"),
            x509.NameAttribute(NameOID.COMMON_NAME, f"{fleet} authority"),
        ]
    )
    identifier = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCK_SKEW)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
        .add_extension(identifier, critical=False)
        .sign(key, hashes.SHA256())
    )
    pem = certificate.public_bytes(serialization.Encoding.PEM)
    return Authority(certificate, key), pem, _key_pem(key, passphrase)


def sign(authority: Authority, name: str, hosts: Sequence[str], days: float, now: datetime) -> Signed:
    """Make a key and a certificate for one platform, usable as TLS client and server.

    Args:
        authority: Who signs.
        name: Common name.
        hosts: DNS names and IP addresses that others reach the platform under.
        days: Validity in days; cut to the authority's own end.
        now: Begin of validity, aware.

    Raises:
        BadInputError: A host is neither a name nor an address.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    end = min(now + timedelta(days=days), authority.certificate.not_valid_after_utc)
    authority_key = authority.certificate.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
    builder = (
        x509.CertificateBuilder()
        .subject_name(x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)]))
        .issuer_name(authority.certificate.subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(now, end) - CLOCK_SKEW)
        .not_valid_after(end)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(
            x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]), critical=False
        )
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(authority_key), critical=False)
    )
    # A CN that is no host name stands among them too: some TLS libraries take no certificate without any.
    alternatives = [general_name(host) for host in dict.fromkeys((name, *hosts))]
    certificate = builder.add_extension(x509.SubjectAlternativeName(alternatives), critical=False).sign(
        authority.key, hashes.SHA256()
    )
    return Signed(certificate, certificate.public_bytes(serialization.Encoding.PEM), _key_pem(key, None))


def general_name(host: str) -> x509.GeneralName:
    """Return a host as it stands in a certificate: an IP address or a DNS name.

    Raises:
        BadInputError: Neither of the two.
    """
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        labels = host.split(".")
        if len(host) > 253 or not all(_HOST_LABEL.fullmatch(label) for label in labels) or labels[-1].isdigit():
            raise BadInputError("certificate", "host", host, "an IP address or a DNS name") from None
        return x509.DNSName(host)


def load_authority(certificate_pem: bytes, key_pem: bytes, passphrase: bytes | None, where: str) -> Authority:
    """Read an authority.

    Raises:
        BadInputError: Damaged, a wrong passphrase, or a key of another certificate. Never quotes a secret.
    """
    certificate = load_certificate(certificate_pem, f"{where}/ca.pem")
    try:
        key = serialization.load_pem_private_key(key_pem, passphrase)
    except TypeError as error:
        got = "no passphrase" if passphrase is None else "a passphrase for a key without one"
        raise BadInputError(where, "ca.key", got, "the passphrase the key was made with") from error
    except ValueError as error:
        raise BadInputError(where, "ca.key", "a wrong passphrase or a damaged key", "the authority's key") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise BadInputError(where, "ca.key", "another key", "the key of ca.pem")
    return Authority(certificate, key)


def load_certificate(pem: bytes, where: str) -> x509.Certificate:
    """Read a certificate.

    Raises:
        BadInputError: Not one. Never quotes what is there: it may be a key in the wrong place.
    """
    try:
        return x509.load_pem_x509_certificate(pem)
    except ValueError as error:
        raise BadInputError(where, "", "something else", "a PEM certificate") from error


def is_encrypted(key_pem: bytes) -> bool:
    """Return whether a private key needs a passphrase."""
    return b"ENCRYPTED" in key_pem


def signed_by(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    """Return whether an authority has signed a certificate."""
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def common_name_of(certificate: x509.Certificate) -> str:
    """Return a certificate's common name, empty when it has none."""
    found = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(found[0].value) if found else ""


def utc(seconds: float) -> datetime:
    """Return a time of seconds since 1970 as aware datetime, whole seconds as certificates have them."""
    return datetime.fromtimestamp(int(seconds), UTC)


def _key_pem(key: ec.EllipticCurvePrivateKey, passphrase: bytes | None) -> bytes:
    protection: serialization.KeySerializationEncryption = serialization.NoEncryption()
    if passphrase is not None:
        protection = serialization.BestAvailableEncryption(passphrase)
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, protection)


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )
