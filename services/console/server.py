"""The web server, in a thread of its own."""

from __future__ import annotations

import logging
import socket
import ssl
import threading

import uvicorn
from starlette.types import ASGIApp

from sonarpost.config import TlsConfig
from sonarpost.errors import ConfigError, PortError
from sonarpost.logs import kv

log = logging.getLogger(__name__)

STOP_S = 1.0
MOST_CONNECTIONS = 200


class WebServer:
    """Serves an application on one address.

    Args:
        app: What is served.
        host: Address to listen on.
        port: TCP port; 0 for any that is free.
        tls: Certificate, for TLS; plain HTTP without.

    Raises:
        PortError: The address cannot be listened on.
        ConfigError: The certificate cannot be used.
    """

    def __init__(self, app: ASGIApp, host: str, port: int, tls: TlsConfig | None = None) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_STREAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._socket.bind((host, port))
            # From here on browsers wait instead of being turned away; they are served when the thread runs.
            self._socket.listen(MOST_CONNECTIONS)
            config = uvicorn.Config(
                app,
                log_config=None,
                access_log=False,
                ws="none",
                lifespan="off",
                server_header=False,
                proxy_headers=False,
                timeout_graceful_shutdown=1,
                limit_concurrency=MOST_CONNECTIONS,
                ssl_certfile=None if tls is None else tls.certificate,
                ssl_keyfile=None if tls is None else tls.key,
            )
            config.load()
        except ssl.SSLError as error:
            self._socket.close()
            raise ConfigError("[platform.tls]", "certificate", str(error), "a certificate and its key (PEM)") from error
        except OSError as error:
            self._socket.close()
            raise PortError(f"{host}:{port}: cannot be listened on: {error}") from error
        self.host = host
        self.port = int(self._socket.getsockname()[1])
        self._tls = tls is not None
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._run, name="web", daemon=True)

    @property
    def address(self) -> str:
        """Where a browser finds it."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self._tls else 'http'}://{host}:{self.port}/"

    @property
    def running(self) -> bool:
        """Whether it serves."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Begin to serve."""
        self._thread.start()
        log.info("Page served", extra=kv(address=self.address))

    def stop(self) -> None:
        """Stop serving, within a second or so."""
        self._server.should_exit = True
        if self._thread.ident is not None:
            self._thread.join(timeout=STOP_S)
            if self._thread.is_alive():
                self._server.force_exit = True
                self._thread.join(timeout=STOP_S)
        self._socket.close()

    def _run(self) -> None:
        self._server.run(sockets=[self._socket])
