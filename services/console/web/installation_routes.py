"""Page of the console with the list of its scripts, and what makes it installable: web manifest, service worker."""

from __future__ import annotations

import functools
import hashlib
import json
import re
from pathlib import Path
from typing import Final

from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

MANIFEST: Final = "manifest.webmanifest"
WORKER: Final = "service_worker.js"
_IMPORT: Final = re.compile(r'^import [^;]*?from "(\.[^"]+)";', re.MULTILINE)
_START: Final = '  <script type="module" src="/static/js/app.js">'
_NO_CACHE: Final = {"Cache-Control": "no-cache"}


def imported_scripts(script: Path) -> list[Path]:
    """Return the scripts that a script imports, directly or through others, sorted and without itself."""
    found: set[Path] = set()
    waiting = [script.resolve()]
    while waiting:
        one = waiting.pop()
        found.add(one)
        others = {(one.parent / name).resolve() for name in _IMPORT.findall(one.read_text(encoding="utf-8"))}
        waiting += others - found
    return sorted(found - {script.resolve()})


@functools.cache
def index_page(static: Path) -> str:
    """Return the page of the console, with links by which the browser loads all its scripts at once."""
    scripts = imported_scripts(static / "js" / "app.js")
    names = [path.relative_to(static.resolve()).as_posix() for path in scripts]
    links = "".join(f'  <link rel="modulepreload" href="/static/{name}">\n' for name in names)
    return (static / "index.html").read_text(encoding="utf-8").replace(_START, links + _START)


@functools.cache
def service_worker(static: Path) -> str:
    """Return the script of the service worker for a folder of static files.

    It begins with the version, a hash of all files, and the addresses of the files that the browser may store. A
    browser installs it again when a file has changed, and removes the files of the version before.
    """
    digest = hashlib.sha256()
    addresses = []
    for path in sorted(path for path in static.rglob("*") if path.is_file()):
        name = path.relative_to(static).as_posix()
        digest.update(f"{name}\0{path.stat().st_size}\0".encode())
        digest.update(path.read_bytes())
        # Pages other than that without a connection need the server.
        if name not in (WORKER, MANIFEST) and (path.suffix != ".html" or name == "offline.html"):
            addresses.append(f"/static/{name}")
    constants = f"const VERSION = {json.dumps(digest.hexdigest()[:16])};\nconst FILES = {json.dumps(addresses)};\n"
    return constants + (static / WORKER).read_text(encoding="utf-8")


def installation_routes(static: Path) -> list[Route]:
    """Return the routes. They need no session, because they contain no data."""

    async def manifest(_request: Request) -> Response:
        return FileResponse(static / MANIFEST, media_type="application/manifest+json", headers=_NO_CACHE)

    async def worker(_request: Request) -> Response:
        return Response(service_worker(static), media_type="text/javascript", headers=_NO_CACHE)

    return [Route(f"/{MANIFEST}", manifest), Route(f"/{WORKER}", worker)]
