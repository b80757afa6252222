"""A certificate authority for tests of TLS with servers and clients that are not of a fleet."""

import ssl
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.serialization import BestAvailableEncryption, Encoding, load_pem_private_key, pkcs12

from builders.fleet_certificates import shifted
from sonarpost.security.certificates import SignedCertificate, load_authority
from sonarpost.security.client_tls import TlsFiles
from sonarpost.security.fleet import CA_CERTIFICATE, CA_KEY, CERTIFICATE, KEY, Fleet


class Authority:
    """A certificate authority that issues files for servers and clients."""

    def __init__(self, folder: Path, name="test"):
        self.fleet = Fleet.init(folder / name, name)

    def issue(self, name, *, expired=False, hosts=("127.0.0.1",)):
        fleet = Fleet(self.fleet.folder, lambda: b"", shifted(-40)) if expired else self.fleet
        folder = fleet.issue(name, "vessel", hosts=hosts, days=10).folder
        return TlsFiles(folder / CA_CERTIFICATE, folder / CERTIFICATE, folder / KEY)

    def encrypted(self, files, passphrase):
        """Write PKCS#12 files of a client and of the authority, and an encrypted key; return their paths."""
        folder = files.certificate.parent
        certificate = x509.load_pem_x509_certificate(files.certificate.read_bytes())
        authority = x509.load_pem_x509_certificate(files.ca.read_bytes())
        key = load_pem_private_key(files.key.read_bytes(), None)
        lock = BestAvailableEncryption(passphrase)
        contents = {
            "client.p12": pkcs12.serialize_key_and_certificates(b"client", key, certificate, [authority], lock),
            "truststore.p12": pkcs12.serialize_key_and_certificates(None, None, None, [authority], lock),
            "key-locked.pem": SignedCertificate(certificate, key).key_pem(passphrase),
        }
        for name, content in contents.items():
            (folder / name).write_bytes(content)
        return [folder / name for name in contents]

    def server_context(self, name="server", *, version=None, revoked=(), hosts=("127.0.0.1",), tickets=2):
        """Return the TLS of a server that requires a certificate of this authority.

        Args:
            name: Name of the server.
            version: The only version of TLS.
            revoked: Files of clients that are on its revocation list.
            hosts: Names and addresses in the server's certificate.
            tickets: Session tickets that it sends with TLS 1.3.
        """
        files = self.issue(name, hosts=hosts)
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(files.certificate, files.key)
        context.load_verify_locations(files.ca)
        context.verify_mode = ssl.CERT_REQUIRED
        context.num_tickets = tickets
        if version is not None:
            context.minimum_version = context.maximum_version = version
        if revoked:
            context.verify_flags |= ssl.VERIFY_CRL_CHECK_LEAF
            context.load_verify_locations(self._revocation_list(revoked))
        return context

    def _revocation_list(self, revoked):
        folder = self.fleet.folder
        authority = load_authority((folder / CA_CERTIFICATE).read_bytes(), (folder / CA_KEY).read_bytes(), None, "test")
        now = datetime.now(UTC)
        builder = x509.CertificateRevocationListBuilder(authority.certificate.subject, now, now + timedelta(days=1))
        for files in revoked:
            serial = x509.load_pem_x509_certificate(files.certificate.read_bytes()).serial_number
            entry = x509.RevokedCertificateBuilder(serial, now).build()
            builder = builder.add_revoked_certificate(entry)
        path = folder / "revoked.pem"
        path.write_bytes(builder.sign(authority.key, hashes.SHA256()).public_bytes(Encoding.PEM))
        return path
