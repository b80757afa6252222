"""Two c2 on one PostgreSQL database are killed in turn, and the database: every record is stored exactly once.

`SONARPOST_HA_CHAOS_S` sets the duration (default 60 s), `SONARPOST_HA_VEHICLES` the number of vehicles (100).
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import zenoh
from builders.common import eventually, free_port
from builders.postgresql import PostgresServer, programs
from builders.records import decision_record, reconstructed_image

from sonarpost import keys, wire
from sonarpost.archive.postgresql import Database, DatabaseAddress
from sonarpost.archive.shore_database import ShoreDatabase
from sonarpost.bus.catch_up import CatchUpSubscriber
from sonarpost.bus.session import client_config, router_config
from sonarpost.codec.registry import default_registry
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.errors import DatabaseUnavailableError
from sonarpost.messages import Command, ImagePart, Pixels, ReconstructedImage, Record, Relayed, TaskingState
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.stop_signals import EXIT_WITH_PARENT

DURATION_S = float(os.environ.get("SONARPOST_HA_CHAOS_S", "60"))
VEHICLES = int(os.environ.get("SONARPOST_HA_VEHICLES", "100"))
VESSELS = 4
KILL_EVERY_S = min(20.0, DURATION_S / 3)
DOWN_S = 5.0
IMAGE_EVERY_S = 10.0
"""Interval of the images of one vehicle."""


class Relay(Service[ServiceConfig]):
    """Relay of one vessel: an outbox to c2, and an inbox for commands."""

    NAME = "relay"
    PUBLISH = False

    def __init__(self, platform: PlatformConfig) -> None:
        super().__init__(platform, ServiceConfig())
        self.commands: Counter[str] = Counter()

    def consumed_keys(self) -> dict[str, type[Record]]:
        return {keys.command_all(self.platform.id): Command}

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        assert isinstance(record, Command)
        self.commands[record.command_id] += 1


class Commander(Service[ServiceConfig]):
    """Sends commands to c2 durably, as the console does."""

    NAME = "console"
    PUBLISH = False

    def handle(self, key: str, record: Record, effects: UnitOfWork) -> None:
        raise AssertionError("consumes nothing")


class SharedShore:
    """PostgreSQL, a router, and two c2 as processes."""

    def __init__(self, folder: Path, server: PostgresServer) -> None:
        self.folder = folder
        self.server = server
        self.url = server.new_database()
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.archive = ShoreDatabase(Database(DatabaseAddress.parse(self.url)), writable=False)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self.kills: Counter[str] = Counter()

    def start(self, name: str) -> None:
        path = self.folder / f"{name}.toml"
        path.write_text(
            f'[platform]\nid = "{name}"\nrouter = ["{self.endpoint}"]\nstate_dir = "{self.folder / name}"\n'
            f'health_interval_s = 1.0\n[c2]\ndatabase = "{self.url}"\n'
        )
        with (self.folder / f"{name}.log").open("ab") as log:
            self._processes[name] = subprocess.Popen(
                [sys.executable, "-m", "sonarpost.services.c2", "--config", str(path)],
                env=os.environ | {EXIT_WITH_PARENT: str(os.getpid())},
                stdout=log,
                stderr=log,
            )

    def kill(self, name: str) -> None:
        self._processes[name].kill()
        self._processes[name].wait()
        self.kills[name] += 1

    def close(self) -> None:
        for process in self._processes.values():
            process.kill()
            process.wait()
        self.archive.close()

    def log_tail(self) -> str:
        return "".join(f"\n--- {path.name}\n{path.read_text()[-3000:]}" for path in self.folder.glob("*.log"))


@pytest.fixture
def shore(tmp_path: Path) -> Iterator[SharedShore]:
    found = programs()
    if found is None:
        pytest.skip("no PostgreSQL server with PostGIS (apt-get install postgresql-postgis)")
    with ExitStack() as stack:
        server = PostgresServer(found)  # a server of its own, because it is killed
        stack.callback(server.close)
        shore = SharedShore(tmp_path, server)
        router = zenoh.open(router_config([shore.endpoint]))
        stack.callback(router.close)
        stack.callback(shore.close)
        yield shore


def make_image(vessel: str, vehicle: int, number: int) -> ReconstructedImage:
    rng = np.random.default_rng([vehicle, number])
    return reconstructed_image(
        Pixels.from_array(rng.integers(0, 256, (60, 80), dtype=np.uint8)),
        vessel_id=vessel,
        vehicle_id=f"uuv-{vehicle}",
        image_id=f"{number:04X}",
        first_frame_utc_s=1.0e9 + number,
        last_frame_utc_s=1.0e9 + number,
    )


def envelope(record: Record, key: str, vessel: str) -> Relayed:
    return Relayed(vessel_id=vessel, key=key, payload=wire.encode(record), relayed_utc_s=time.time())


def read_late(session: zenoh.Session) -> Counter[str]:
    """Return the images and decisions that a new subscriber receives until it has caught up."""
    found: Counter[str] = Counter()
    with CatchUpSubscriber(session, keys.shore_contact_all("shore")) as records:
        stop = threading.Thread(target=lambda: (eventually(lambda: records.is_caught_up, 300.0), records.close()))
        stop.start()
        for record in records:
            fields = wire.unpack_map(record.payload, record.key)
            if fields["type"] == "decision":
                found[str(fields["decision_id"])] += 1
            elif fields["type"] == "reconstructed_image":
                found["/".join(str(fields[name]) for name in ("vessel_id", "vehicle_id", "image_id"))] += 1
        stop.join()
    return found


@pytest.mark.system
@pytest.mark.timeout(1800)
def test_two_c2_and_their_database_are_killed_and_nothing_is_lost_or_doubled(shore: SharedShore) -> None:  # noqa: C901, PLR0912
    vessels = [f"vessel-{number}" for number in range(VESSELS)]
    noise = np.random.default_rng(1).integers(0, 256, (40, 60), dtype=np.uint8)
    stream = default_registry().create("spiht").encode(noise, 200)
    expected: set[tuple[str, str, str]] = set()
    decisions: set[str] = set()
    commands: set[str] = set()
    with ExitStack() as stack:

        def running(service: type[Service[ServiceConfig]] | type[Relay], name: str) -> Service[ServiceConfig]:
            platform = PlatformConfig(
                id=name, router=(shore.endpoint,), state_dir=shore.folder / name, acoustic_auth="none"
            )
            made = service(platform) if service is Relay else service(platform, ServiceConfig())  # type: ignore[call-arg,arg-type]
            assert made.start()
            stack.callback(made.stop)
            return made  # type: ignore[return-value]

        relays = {vessel: running(Relay, vessel) for vessel in vessels}
        commander = running(Commander, "shore-console")
        session = zenoh.open(client_config([shore.endpoint]))
        stack.callback(session.close)
        published: Counter[str] = Counter()
        session.declare_subscriber(
            keys.shore_contact_all("shore"), lambda sample: published.update([str(sample.key_expr)])
        )
        states: dict[str, str] = {}

        def on_state(sample: zenoh.Sample) -> None:
            state = wire.decode(TaskingState, sample.payload.to_bytes(), str(sample.key_expr))
            states[state.record_id] = state.state

        session.declare_subscriber(keys.tasking_state_all("shore"), on_state)
        for name in ("shore-1", "shore-2"):
            shore.start(name)
        hosts = itertools.cycle(("shore-1", "shore-2"))
        start_s = time.monotonic()
        kill_at_s, down, database_killed = KILL_EVERY_S, "", False
        up_at_s = 0.0
        number = 0
        while (elapsed_s := time.monotonic() - start_s) < DURATION_S:
            if elapsed_s >= number * IMAGE_EVERY_S / VEHICLES:
                vehicle = number % VEHICLES
                vessel = vessels[vehicle % VESSELS]
                image = make_image(vessel, vehicle, number // VEHICLES)
                expected.add((vessel, image.vehicle_id, image.image_id))
                effects = UnitOfWork()
                key = keys.shore_inbox(vessel)
                if number % 2:
                    part = ImagePart(u=image.vehicle_id, i=image.image_id, n=1, t=image.first_frame_utc_s, p=stream)
                    effects.send(keys.shore_part(vessel), "c2", part)
                else:
                    effects.send(key, "c2", envelope(image, keys.image_reconstructed(vessel), vessel))
                if number % 10 == 0:
                    decision = decision_record(f"d{number}", vessel_id=vessel, vehicle_id=image.vehicle_id)
                    decisions.add(decision.decision_id)
                    effects.send(key, "c2", envelope(decision, keys.contact_decision(vessel), vessel))
                relays[vessel].commit(effects)
                if number % 50 == 0:
                    command = Command(
                        command_id=f"c{number}",
                        kind="refine",
                        vehicle_id=image.vehicle_id,
                        image_id=image.image_id,
                        issued_by="expert",
                        issued_utc_s=time.time(),
                    )
                    commands.add(command.command_id)
                    effects = UnitOfWork()
                    effects.send(keys.tasking_command(vessel), "c2", command)
                    commander.commit(effects)
                number += 1
            if down and elapsed_s >= up_at_s:
                shore.start(down)
                down = ""
            if not down and elapsed_s >= kill_at_s:
                down, up_at_s, kill_at_s = next(hosts), elapsed_s + DOWN_S, kill_at_s + KILL_EVERY_S
                shore.kill(down)
            if not database_killed and elapsed_s >= 0.6 * DURATION_S:
                database_killed = True
                shore.server.stop("immediate")
                time.sleep(2.0)
                shore.server.start()
                shore.kills["postgresql"] += 1
            time.sleep(0.002)
        if down:
            shore.start(down)

        def is_stored() -> bool:
            try:
                rows = shore.archive.images()
                found = {(row.vessel_id, row.vehicle_id, row.image_id) for row in rows}
                done = found == expected and {row.decision_id for row in shore.archive.decisions()} == decisions
                return done and shore.archive.accepted_count() == 0
            except DatabaseUnavailableError:
                return False

        try:
            eventually(is_stored, 300.0, "every record in the database")
            eventually(lambda: all(states.get(each) == "delivered" for each in commands), 120.0, "delivered commands")
        except pytest.fail.Exception as failure:
            rows = shore.archive.images()
            found = {(row.vessel_id, row.vehicle_id, row.image_id) for row in rows}
            waiting = {name: each.store.outbox_depth() for name, each in relays.items()}
            pytest.fail(
                f"{failure}; missing {sorted(expected - found)[:20]} of {len(expected)}, accepted"
                f" {shore.archive.accepted_count()}, outbox {waiting}, commands"
                f" {[each for each in commands if states.get(each) != 'delivered']}{shore.log_tail()}"
            )
        # Exactly once: one row for each image, none of them under the name of a conflict, and all contents intact.
        rows = shore.archive.images()
        assert len(rows) == len(expected)
        assert shore.archive.defect_counts()["conflicting"] == 0
        results = shore.archive.verify(time.time() + 2 * 86400.0, 86400.0, 86400.0)
        assert len(results) == len(rows) + len(decisions)
        assert {result.fault for result in results} == {""}
        received: Counter[str] = Counter()
        for relay in relays.values():
            assert isinstance(relay, Relay)
            received.update(relay.commands)
        assert received == Counter(dict.fromkeys(commands, 1)), "each command reaches its vessel once"
        assert sum(each.store.outbox_depth() for each in relays.values()) == 0
        # One c2 does not return: a late subscriber receives the records of both from the other one, each once.
        shore.kill("shore-1")
        assert read_late(session) == Counter(
            [f"{vessel}/{vehicle}/{image_id}" for vessel, vehicle, image_id in expected] + sorted(decisions)
        )
        images = sum(count for key, count in published.items() if key.endswith("/image"))
        print(
            f"\n{DURATION_S:.0f} s, {VEHICLES} vehicles: {len(expected)} images, {len(decisions)} decisions,"
            f" {len(commands)} commands exactly once; kills {dict(shore.kills)}; images published {images}"
        )
