"""Keys and certificates of a fleet: EC P-256, SHA-256, PEM. No file access.

The common name (CN) of a certificate is the platform, with `.g{n}` appended from the second generation on. Zenoh's
access control identifies a peer by its CN only and reads no revocation list. A revoked CN is therefore never used
again, and the platform gets a new one: `vessel-1`, `vessel-1.g2`, `vessel-1.g3`.
"""

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
from sonarpost.keys import SHORE

# A certificate is valid from a little earlier, for hosts whose clock is behind.
CLOCK_SKEW = timedelta(minutes=10)
_HOST_LABEL = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?")
_COMMON_NAME = re.compile(r"(?P<platform>[a-z0-9][a-z0-9-]{0,31})(?:\.g(?P<generation>[1-9][0-9]{0,5}))?")


def check_platform(platform: str) -> None:
    """Check the name of a platform.

    Raises:
        BadInputError: It is invalid, or the name that every shore site shares.
    """
    if "." in platform or not _COMMON_NAME.fullmatch(platform):
        expected = "1 to 32 of a-z, 0-9 and '-', the first a letter or digit"
        raise BadInputError("pki", "platform", platform, expected)
    if platform == SHORE:
        # Its prefix holds the inboxes of all vessels.
        raise BadInputError("pki", "platform", platform, f"a unique name, such as {SHORE}-1")


def common_name(platform: str, generation: int) -> str:
    """Return the CN of a platform's certificate; generations count from 1."""
    return platform if generation == 1 else f"{platform}.g{generation}"


def platform_of(name: str) -> tuple[str, int]:
    """Return platform and generation of a CN.

    Raises:
        BadInputError: It is not a common name of this form.
    """
    match = _COMMON_NAME.fullmatch(name)
    if match is None or match["generation"] == "1":
        raise BadInputError("certificate", "common name", name, "a platform's name, from the second on with .g2, .g3 …")
    return match["platform"], int(match["generation"] or 1)


@dataclass(frozen=True, slots=True)
class SignedCertificate:
    """A certificate and its private key."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey

    def certificate_pem(self) -> bytes:
        """Return the certificate as PEM."""
        return self.certificate.public_bytes(serialization.Encoding.PEM)

    def key_pem(self, passphrase: bytes | None = None) -> bytes:
        """Return the key as PEM, encrypted if there is a passphrase."""
        encryption: serialization.KeySerializationEncryption = serialization.NoEncryption()
        if passphrase is not None:
            encryption = serialization.BestAvailableEncryption(passphrase)
        return self.key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, encryption)


def create_authority(fleet: str, days: int, now_utc_s: float) -> SignedCertificate:
    """Create a self-signed authority that can sign certificates of platforms but no other authority."""
    now = _utc(now_utc_s)
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name(
        [
            x509.NameAttribute(NameOID.ORGANIZATION_NAME, "sonarpost"),
            x509.NameAttribute(NameOID.COMMON_NAME, f"{fleet} authority"),
        ]
    )
    builder = _builder(name, name, key, now, now + timedelta(days=days), is_authority=True)
    return SignedCertificate(builder.sign(key, hashes.SHA256()), key)


def sign(
    authority: SignedCertificate, name: str, hosts: Sequence[str], days: float, now_utc_s: float
) -> SignedCertificate:
    """Create key and certificate of a platform, for TLS clients and servers.

    Args:
        authority: The signing authority.
        name: Common name.
        hosts: DNS names and IP addresses of the platform.
        days: Validity in days; limited to the end of the authority.
        now_utc_s: Start of the validity.

    Raises:
        BadInputError: A host is neither a name nor an address.
    """
    now = _utc(now_utc_s)
    key = ec.generate_private_key(ec.SECP256R1())
    end = min(now + timedelta(days=days), authority.certificate.not_valid_after_utc)
    # The CN is among the alternative names: some TLS libraries reject a certificate without any.
    alternatives = [_general_name(host) for host in dict.fromkeys((name, *hosts))]
    authority_key = authority.certificate.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    usage = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
    certificate = (
        _builder(subject, authority.certificate.subject, key, min(now, end), end, is_authority=False)
        .add_extension(usage, critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(authority_key), critical=False)
        .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        .sign(authority.key, hashes.SHA256())
    )
    return SignedCertificate(certificate, key)


def _builder(
    subject: x509.Name,
    issuer: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    begin: datetime,
    end: datetime,
    *,
    is_authority: bool,
) -> x509.CertificateBuilder:
    usage = x509.KeyUsage(
        digital_signature=not is_authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=is_authority,
        crl_sign=is_authority,
        encipher_only=False,
        decipher_only=False,
    )
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(begin - CLOCK_SKEW)
        .not_valid_after(end)
        .add_extension(x509.BasicConstraints(ca=is_authority, path_length=0 if is_authority else None), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        labels = host.split(".")
        if len(host) > 253 or not all(_HOST_LABEL.fullmatch(label) for label in labels) or labels[-1].isdigit():
            raise BadInputError("certificate", "host", host, "an IP address or a DNS name") from None
        return x509.DNSName(host)


def load_authority(certificate_pem: bytes, key_pem: bytes, passphrase: bytes | None, where: str) -> SignedCertificate:
    """Load an authority.

    Raises:
        BadInputError: Damaged, a wrong passphrase, or a key of another certificate. The message holds no secret.
    """
    certificate = load_certificate(certificate_pem, f"{where}/ca.pem")
    try:
        key = serialization.load_pem_private_key(key_pem, passphrase)
    except TypeError as error:
        got = "no passphrase" if passphrase is None else "a passphrase for a key without one"
        raise BadInputError(where, "ca.key", got, "the passphrase of the key") from error
    except ValueError as error:
        raise BadInputError(where, "ca.key", "a wrong passphrase or a damaged key", "the authority's key") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise BadInputError(where, "ca.key", "another key", "the key of ca.pem")
    return SignedCertificate(certificate, key)


def load_certificate(pem: bytes, where: str) -> x509.Certificate:
    """Load a certificate.

    Raises:
        BadInputError: It is not one. The message does not quote the content, which can be a misplaced key.
    """
    try:
        return x509.load_pem_x509_certificate(pem)
    except ValueError as error:
        raise BadInputError(where, "", "something else", "a PEM certificate") from error


def is_signed_by(certificate: x509.Certificate, authority: x509.Certificate) -> bool:
    """Return whether an authority has signed a certificate."""
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        return False
    return True


def common_name_of(certificate: x509.Certificate) -> str:
    """Return the common name of a certificate, empty if it has none."""
    found = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(found[0].value) if found else ""


def _utc(seconds: float) -> datetime:
    """Return a time in whole seconds, as certificates hold it."""
    return datetime.fromtimestamp(int(seconds), UTC)
