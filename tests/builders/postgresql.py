"""A PostgreSQL server with PostGIS in a temporary folder, as Debian's packages install it."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from itertools import count
from pathlib import Path

import pytest

from builders.common import free_port
from sonarpost.archive.address import DatabaseAddress
from sonarpost.archive.postgresql import PostgresDatabase
from sonarpost.archive.shore_archive import ShoreArchive

USER = "sonarpost"
TEMPLATE = "with_postgis"
PROGRAMS = Path("/usr/lib/postgresql")
OPTIONS = "-F -c max_connections=60 -c shared_buffers=32MB -c full_page_writes=off"


def programs() -> Path | None:
    """Return the folder with the programs of the newest installed server that has PostGIS; None if there is none."""
    found = [
        folder / "bin"
        for folder in sorted(PROGRAMS.glob("*"), key=lambda path: int(path.name) if path.name.isdecimal() else 0)
        if (folder / "bin" / "initdb").is_file()
        and list(Path("/usr/share/postgresql", folder.name, "extension").glob("postgis.control"))
    ]
    return found[-1] if found else None


class PostgresServer:
    """A server on a loopback port, which can be killed and started again; its data are not flushed to the disk."""

    def __init__(self, programs: Path) -> None:
        self._programs = programs
        self._folder = Path(tempfile.mkdtemp(prefix="sonarpost-postgresql-"))
        self._user: list[str] = []
        if os.getuid() == 0:
            # initdb refuses root.
            shutil.chown(self._folder, "postgres", "postgres")
            self._user = ["setpriv", "--reuid=postgres", "--regid=postgres", "--clear-groups", "--"]
        self.port = free_port()
        self._numbers = count()
        self._run("initdb", "--no-sync", "-A", "trust", "-U", "postgres", "-D", str(self._folder / "data"))
        self.start()
        self.execute("postgres", f"CREATE ROLE {USER} LOGIN")
        self.execute("postgres", f"CREATE DATABASE {TEMPLATE}")
        self.execute(TEMPLATE, "CREATE EXTENSION postgis")

    def _run(self, program: str, *arguments: str) -> None:
        command = [*self._user, str(self._programs / program), *arguments]
        environment = {"PATH": os.environ["PATH"], "LC_ALL": "C.UTF-8"}
        done = subprocess.run(
            command,
            cwd="/",
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stdout.decode(errors="replace")

    def start(self) -> None:
        """Start the server and wait until it accepts connections."""
        options = f"{OPTIONS} -k {self._folder} -c listen_addresses=127.0.0.1 -p {self.port}"
        log = self._folder / "log"
        self._run("pg_ctl", "-w", "-s", "-D", str(self._folder / "data"), "-l", str(log), "-o", options, "start")

    def stop(self, mode: str = "fast") -> None:
        """Stop the server; `immediate` is a crash, from which the next start recovers."""
        self._run("pg_ctl", "-w", "-s", "-D", str(self._folder / "data"), "-m", mode, "stop")

    def close(self) -> None:
        """Stop the server and delete its data."""
        self.stop("immediate")
        shutil.rmtree(self._folder)

    def execute(self, database: str, statement: str, user: str = "postgres") -> list[list[object]]:
        """Run a statement outside a transaction, as superuser."""
        from pg8000.native import Connection

        connection = Connection(user, host="127.0.0.1", port=self.port, database=database, ssl_context=False)
        try:
            rows: list[list[object]] | None = connection.run(statement)
        finally:
            connection.close()
        return rows or []

    def new_database(self) -> str:
        """Create a database with PostGIS; return its address."""
        name = f"shore_{next(self._numbers)}"
        self.execute("postgres", f"CREATE DATABASE {name} OWNER {USER} TEMPLATE {TEMPLATE}")
        return f"postgresql://{USER}@127.0.0.1:{self.port}/{name}"


@pytest.fixture(scope="session")
def postgresql_server() -> Iterator[PostgresServer]:
    """A server for all tests of a worker."""
    found = programs()
    if found is None:
        pytest.skip("no PostgreSQL server with PostGIS (apt-get install postgresql-postgis)")
    server = PostgresServer(found)
    yield server
    server.close()


@pytest.fixture
def database_url(postgresql_server: PostgresServer) -> str:
    """Address of an empty database."""
    return postgresql_server.new_database()


@pytest.fixture
def database(database_url: str) -> Iterator[PostgresDatabase]:
    """Connections to an empty database."""
    database = PostgresDatabase(DatabaseAddress.parse(database_url))
    yield database
    database.close()


def execute(archive: ShoreArchive, statement: str) -> Sequence[Sequence[object]]:
    """Run a statement in the database of an archive; return its rows."""
    with archive.database.transaction() as sql:
        done = sql.exec_driver_sql(statement)
        return done.all() if done.returns_rows else []
