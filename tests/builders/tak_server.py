"""A TAK server for tests, plain TCP or TLS, that can refuse, stop or ignore a client; and certificates for it."""

from __future__ import annotations

import socket
import ssl
import struct
import threading
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    load_pem_private_key,
    pkcs12,
)

from builders.fleet_certificates import shifted
from sonarpost.export.tak.cot_sender import TlsFiles
from sonarpost.security.certificates import SignedCertificate, load_authority
from sonarpost.security.fleet import CA_CERTIFICATE, CA_KEY, CERTIFICATE, KEY, Fleet


class TakServer:
    """Listener that stores what it reads of each connection.

    Args:
        context: TLS; None for plain TCP.
        port: Port; 0 for a free one.
        greeting: Sent to each client at the start.
        reset_in: Number of the connection that is reset when `reset_after` bytes of it were read.
        keeps_open: Connections stay open after the end of the client.
        closes_after: Bytes of a connection after which the server closes it by itself.
    """

    def __init__(
        self, context=None, *, port=0, greeting=b"", reset_in=None, reset_after=1, keeps_open=False, closes_after=None
    ):
        self.received: list[bytearray] = []
        self.ended: list[bool] = []
        """Whether the client has ended the connection."""
        self._connections: list[socket.socket] = []
        self._context = context
        self._greeting = greeting
        self._reset_in, self._reset_after = reset_in, reset_after
        self._keeps_open, self._closes_after = keeps_open, closes_after
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._accept, daemon=True)
        self._thread.start()

    def events(self):
        """Return the number of events in the connections that clients have ended."""
        return sum(data.count(b"<event") for data, ended in zip(self.received, self.ended, strict=True) if ended)

    def close(self):
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._thread.join()
        for connection in self._connections:
            connection.close()

    def _accept(self):
        while True:
            try:
                connection = self._listener.accept()[0]
            except OSError:
                return
            try:
                if self._context is not None:
                    connection = self._context.wrap_socket(connection, server_side=True)
                connection.sendall(self._greeting)
            except OSError:
                connection.close()
                continue
            self._connections.append(connection)
            self.received.append(bytearray())
            self.ended.append(False)
            threading.Thread(target=self._read, args=(connection, len(self.received) - 1), daemon=True).start()

    def _read(self, connection, number):
        data = self.received[number]
        try:
            while piece := connection.recv(4096):
                data += piece
                if number == self._reset_in and len(data) >= self._reset_after:
                    connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    connection.close()
                    return
                if self._closes_after is not None and len(data) >= self._closes_after:
                    connection.close()
                    return
        except OSError:
            return
        self.ended[number] = True
        if not self._keeps_open:
            connection.close()


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
