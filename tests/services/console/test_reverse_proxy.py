"""The shipped configuration of nginx, with a real nginx on the local host."""

import os
import shutil
import socket
import ssl
import subprocess

import httpx2
import pytest
from builders.common import REPOSITORY, WAIT_S, eventually, free_port
from builders.console import Browser, EventReader, image_record, server_certificate, web_server

from sonarpost.network.connections import ConnectionLimits, TrustedProxies

CONFIGURATION = REPOSITORY / "packaging" / "nginx" / "sonarpost-console.conf"
NGINX = os.environ.get("SONARPOST_NGINX") or shutil.which("nginx") or shutil.which("nginx", path="/usr/sbin")
PROXY = "127.0.0.1"
needs_nginx = pytest.mark.skipif(NGINX is None, reason="no nginx: apt-get install nginx, or set SONARPOST_NGINX")


class Proxied:
    """A console behind nginx."""

    def __init__(self, port, certificate):
        self.port = port
        self.address = f"https://{PROXY}:{port}/"
        self.tls = ssl.create_default_context(cafile=str(certificate.ca))

    def client(self, source: str = PROXY) -> httpx2.Client:
        transport = httpx2.HTTPTransport(local_address=source, verify=self.tls)
        return httpx2.Client(base_url=self.address, transport=transport, timeout=120)


@pytest.fixture
def proxied(make_console, tmp_path):
    console = make_console(trusted_proxies=(PROXY,))
    limits = ConnectionLimits(TrustedProxies(console.state.config.trusted_proxies))
    port = free_port()
    with web_server(console, limits=limits) as server:
        certificate = server_certificate(tmp_path)
        text = CONFIGURATION.read_text(encoding="utf-8")
        for old, new in (
            ("listen 443 ssl", f"listen {PROXY}:{port} ssl"),
            ("server_name bridge.example", f"server_name {PROXY}"),
            ("server 127.0.0.1:8470", f"server 127.0.0.1:{server.port}"),
            ("/etc/sonarpost/tls/console.pem", str(certificate.certificate)),
            ("/etc/sonarpost/tls/console.key", str(certificate.key)),
        ):
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "console.conf").write_text(text)
        folders = "".join(
            f"{kind}_temp_path {tmp_path}/{kind};\n" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
        )
        (tmp_path / "nginx.conf").write_text(
            f"daemon off; pid {tmp_path}/pid; error_log stderr warn; events {{ worker_connections 512; }}\n"
            f"{'user root;' if os.geteuid() == 0 else ''}\n"
            f"http {{ access_log off; {folders} include {tmp_path}/console.conf; }}\n"
        )
        words = [str(NGINX), "-e", "stderr", "-p", str(tmp_path), "-c", str(tmp_path / "nginx.conf")]
        subprocess.run([*words, "-t"], check=True)
        with subprocess.Popen(words) as process:
            eventually(lambda: is_open(port), what="nginx")
            yield Proxied(port, certificate), console
            console.app.stop()
            process.terminate()


def is_open(port: int) -> bool:
    try:
        socket.create_connection((PROXY, port), 1).close()
    except OSError:
        return False
    return True


@needs_nginx
def test_console_behind_nginx(proxied):
    proxy, console = proxied
    console.state.store_image(image_record())
    with proxy.client() as client, proxy.client("127.0.0.2") as other:
        client.headers["X-Forwarded-For"] = "192.0.2.1"
        anna, bo = Browser(client), Browser(other)
        answer = anna.login("anna")
        assert answer.status_code == 200
        cookies = answer.headers.get_list("set-cookie")
        assert len(cookies) == 2
        assert all("secure" in cookie.lower() and "httponly" in cookie.lower() for cookie in cookies)
        assert anna.get("/api/contacts").json()["total"] == 1
        [contact] = anna.get("/api/contacts").json()["items"]
        assert anna.decide(contact["id"]).status_code == 201
        # The address of the browser, not the forged one and not that of the proxy.
        assert bo.login("bo").status_code == 200
        assert bo.decide(contact["id"]).status_code == 201
        assert [entry["address"] for entry in bo.contact(contact["id"])["audit"]] == ["127.0.0.1", "127.0.0.2"]
        assert len(anna.get("/api/export/contacts.kmz").content) > 1000


@pytest.mark.system
@needs_nginx
def test_half_requests_end_in_nginx_and_keep_no_one_out(proxied):
    proxy, _console = proxied
    held = []
    for _ in range(230):
        held.append(proxy.tls.wrap_socket(socket.create_connection((PROXY, proxy.port), WAIT_S), server_hostname=PROXY))
        held[-1].sendall(b"GET /login HTTP/1.1\r\nHost: 127.0.0.1\r\n")
    with proxy.client() as client:
        assert Browser(client).login("anna").status_code == 200
    for one in held:
        one.settimeout(WAIT_S)
        try:
            assert one.recv(100)[:12] in (b"", b"HTTP/1.1 408")
        except ConnectionResetError:
            pass
        finally:
            one.close()


@pytest.mark.system
@needs_nginx
def test_event_stream_through_nginx_is_not_delayed(proxied):
    proxy, console = proxied
    token = console.users.start_session("anna").token
    page = EventReader(proxy.address, token, context=proxy.tls)
    eventually(lambda: "hello" in page.names(), what="stream")
    console.state.store_image(image_record())
    eventually(lambda: "contact" in page.names(), what="event")
    page.close()
