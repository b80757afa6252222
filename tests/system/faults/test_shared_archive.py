"""Two c2 on one PostgreSQL database are killed in turn, and the database: every record is stored exactly once.

`SONARPOST_HA_CHAOS_S` repeats the three faults for a duration (default: once), `SONARPOST_HA_VEHICLES` sets the number
of vehicles (100).
"""

import os
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import ExitStack

import numpy as np
import pytest
import zenoh
from builders.common import eventually, free_port
from builders.postgresql import PostgresServer, programs
from builders.progress import wait_while_progressing
from builders.records import decision_record, reconstructed_image

from sonarpost import keys, wire
from sonarpost.archive.address import DatabaseAddress
from sonarpost.archive.reader import open_archive
from sonarpost.bus.catch_up import CatchUpSubscriber
from sonarpost.bus.session import client_config, router_config
from sonarpost.codec.registry import default_registry
from sonarpost.config import PlatformConfig, ServiceConfig
from sonarpost.errors import DatabaseUnavailableError
from sonarpost.messages import Command, Health, ImagePart, Pixels, Relayed, TaskingState
from sonarpost.runtime.service import Service, UnitOfWork
from sonarpost.stop_signals import EXIT_WITH_PARENT

DURATION_S = float(os.environ.get("SONARPOST_HA_CHAOS_S", "0"))
VEHICLES = int(os.environ.get("SONARPOST_HA_VEHICLES", "100"))
VESSELS = [f"vessel-{number}" for number in range(4)]
C2 = ("shore-1", "shore-2")


class Relay(Service[ServiceConfig]):
    """Relay of one vessel: an outbox to c2, and an inbox for commands."""

    NAME = "relay"
    PUBLISH = False

    def __init__(self, platform):
        super().__init__(platform, ServiceConfig())
        self.commands = Counter()

    def consumed_keys(self):
        return {keys.command_all(self.platform.id): Command}

    def handle(self, key, record, effects):
        assert isinstance(record, Command)
        self.commands[record.command_id] += 1


class Commander(Service[ServiceConfig]):
    """Sends commands to c2 durably, as the console does."""

    NAME = "console"
    PUBLISH = False

    def handle(self, key, record, effects):
        raise AssertionError("consumes nothing")


class SharedShore:
    """PostgreSQL, a router, and two c2 as processes."""

    def __init__(self, folder, server):
        self.folder = folder
        self.server = server
        self.url = server.new_database()
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.archive = open_archive(DatabaseAddress.parse(self.url), writable=False)
        self._processes = {}
        self.kills = Counter()

    def start(self, name):
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

    def kill(self, name):
        self._processes[name].kill()
        self._processes[name].wait()
        self.kills[name] += 1

    def close(self):
        for process in self._processes.values():
            process.kill()
            process.wait()
        self.archive.close()

    def log_tail(self):
        return "".join(f"\n--- {path.name}\n{path.read_text()[-3000:]}" for path in self.folder.glob("*.log"))


@pytest.fixture
def shore(tmp_path):
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


class Traffic:
    """Relays of the vessels and a console, and what they have sent to c2."""

    def __init__(self, shore, stack):
        self.shore = shore
        self.number = 0
        self.images = set()
        self.decisions = set()
        self.commands = set()
        self.published = 0
        self.states = {}
        self.health = {}
        self._noise = np.random.default_rng(1).integers(0, 256, (40, 60), dtype=np.uint8)
        self._stream = default_registry().create("emb").encode(self._noise, 200)
        platforms = {
            name: PlatformConfig(id=name, router=(shore.endpoint,), state_dir=shore.folder / name, acoustic_auth="none")
            for name in (*VESSELS, "shore-console")
        }
        self.commander = Commander(platforms.pop("shore-console"), ServiceConfig())
        self.relays = {vessel: Relay(platform) for vessel, platform in platforms.items()}
        for service in (self.commander, *self.relays.values()):
            assert service.start()
            stack.callback(service.stop)
        self.session = zenoh.open(client_config([shore.endpoint]))
        stack.callback(self.session.close)
        self.session.declare_subscriber(keys.shore_contact_all("shore"), self._on_published)
        self.session.declare_subscriber(keys.tasking_state_all("shore"), self._on_state)
        for name in C2:
            self.session.declare_subscriber(keys.health_all(name), self._on_health)

    def _on_published(self, sample):
        self.published += str(sample.key_expr).endswith("/image")

    def _on_state(self, sample):
        state = wire.decode(TaskingState, sample.payload.to_bytes(), str(sample.key_expr))
        self.states[state.record_id] = state.state

    def _on_health(self, sample):
        health = wire.decode(Health, sample.payload.to_bytes(), str(sample.key_expr))
        self.health[health.platform_id] = health

    def send(self, count):
        """Queue images: every second one as a part of a stream, with some decisions and commands."""
        for number in range(self.number, self.number + count):
            vehicle = number % VEHICLES
            vessel = VESSELS[vehicle % len(VESSELS)]
            image = make_image(vessel, vehicle, number // VEHICLES)
            key = keys.shore_inbox(vessel)
            effects = UnitOfWork()
            if number % 2:
                part = ImagePart(u=image.vehicle_id, i=image.image_id, n=1, t=image.first_frame_utc_s, p=self._stream)
                effects.send(keys.shore_part(vessel), "c2", part)
            else:
                effects.send(key, "c2", envelope(image, keys.image_reconstructed(vessel), vessel))
            if number % 10 == 0:
                decision = decision_record(f"d{number}", vessel_id=vessel, vehicle_id=image.vehicle_id)
                effects.send(key, "c2", envelope(decision, keys.contact_decision(vessel), vessel))
                self.decisions.add(decision.decision_id)
            self.relays[vessel].commit(effects)
            self.images.add((vessel, image.vehicle_id, image.image_id))
            if number % 20 == 0:
                self._send_command(vessel, f"c{number}", image)
        self.number += count

    def _send_command(self, vessel, name, image):
        of_image = {"vehicle_id": image.vehicle_id, "image_id": image.image_id}
        command = Command(command_id=name, kind="refine", **of_image, issued_by="expert", issued_utc_s=time.time())
        effects = UnitOfWork()
        effects.send(keys.tasking_command(vessel), "c2", command)
        self.commander.commit(effects)
        self.commands.add(name)

    def _stored(self):
        archive = self.shore.archive
        try:
            images = {(row.vessel_id, row.vehicle_id, row.image_id) for row in archive.images()}
            return images, {row.decision_id for row in archive.decisions()}, archive.backlog.count()
        except DatabaseUnavailableError:
            return None

    def _waiting(self):
        return tuple(service.store.outbox_depth() for service in (self.commander, *self.relays.values()))

    def _progress(self):
        stored = self._stored()
        return stored and [len(stored[0]), len(stored[1]), stored[2]], self._waiting(), sorted(self.states.items())

    def _describe(self):
        stored = self._stored() or (set(), set(), 0)
        missing = sorted(self.images - stored[0])[:20], sorted(self.decisions - stored[1])
        return f"missing {missing}, accepted {stored[2]}, outboxes {self._waiting()}{self.shore.log_tail()}"

    def until(self, condition, what):
        wait_while_progressing(condition, self._progress, what, self._describe)

    def until_stored(self, *, with_commands=True):
        """Wait until every record is stored, and every command is at its vessel."""
        self.until(lambda: self._stored() == (self.images, self.decisions, 0), "every record in the database")
        if with_commands:
            self.until(lambda: all(self.states.get(c) == "delivered" for c in self.commands), "delivered commands")

    def until_degraded(self):
        """Wait until both c2 report that they cannot store."""
        since_utc_s = time.time()
        reports = self.health

        def degraded():
            found = [reports[name] for name in C2 if name in reports and reports[name].time_utc_s > since_utc_s]
            return len(found) == len(C2) and all(health.state == "degraded" for health in found)

        self.until(degraded, "both c2 report the outage")


def make_image(vessel, vehicle, number):
    rng = np.random.default_rng([vehicle, number])
    return reconstructed_image(
        Pixels.from_array(rng.integers(0, 256, (60, 80), dtype=np.uint8)),
        vessel_id=vessel,
        vehicle_id=f"uuv-{vehicle}",
        image_id=f"{number:04X}",
        first_frame_utc_s=1.0e9 + number,
        last_frame_utc_s=1.0e9 + number,
    )


def envelope(record, key, vessel):
    return Relayed(vessel_id=vessel, key=key, payload=wire.encode(record), relayed_utc_s=time.time())


def read_late(session):
    """Return the images and decisions that a new subscriber receives until it has caught up."""
    found = Counter()
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


@pytest.mark.timeout(2 * DURATION_S + 1800)
def test_two_c2_and_their_database_are_killed_and_nothing_is_lost_or_doubled(shore):
    with ExitStack() as stack:
        traffic = Traffic(shore, stack)
        for name in C2:
            shore.start(name)
        start_s = time.monotonic()
        while traffic.number == 0 or time.monotonic() - start_s < DURATION_S:
            for name in C2:
                traffic.send(60)
                traffic.until(lambda: traffic.states.get(f"c{traffic.number - 20}") is not None, "c2 at work")
                shore.kill(name)
                traffic.send(60)
                # By the other one; only the c2 that has claimed a command sends it.
                traffic.until_stored(with_commands=False)
                shore.start(name)
            traffic.health.clear()
            traffic.until(lambda: set(traffic.health) == set(C2), "both c2")
            traffic.send(60)
            shore.server.stop("immediate")
            shore.kills["postgresql"] += 1
            traffic.send(60)
            traffic.until_degraded()
            shore.server.start()
            traffic.until_stored()
        # Exactly once: one row for each image, none of them under the name of a conflict, and all contents intact.
        rows = shore.archive.images()
        assert len(rows) == len(traffic.images)
        assert shore.archive.defect_counts()["conflicting"] == 0
        results = shore.archive.verify(time.time() + 2 * 86400.0, 86400.0, 86400.0)
        assert len(results) == len(rows) + len(traffic.decisions)
        assert {result.fault for result in results} == {""}
        depths = [f for r in traffic.relays.values() for f in (r.store.outbox_depth, r.store.inbox_depth)]
        eventually(lambda: not any(depth() for depth in depths), what="empty stores of the relays")
        received = Counter()
        for relay in traffic.relays.values():
            received.update(relay.commands)
        assert received == Counter(dict.fromkeys(traffic.commands, 1)), "each command reaches its vessel once"
        # One c2 does not return: a late subscriber receives the records of both from the other one, each once.
        shore.kill("shore-1")
        assert read_late(traffic.session) == Counter(
            [*("/".join(image) for image in traffic.images), *traffic.decisions]
        )
        print(
            f"\n{time.monotonic() - start_s:.0f} s, {VEHICLES} vehicles: {len(traffic.images)} images,"
            f" {len(traffic.decisions)} decisions, {len(traffic.commands)} commands exactly once; kills"
            f" {dict(shore.kills)}; images published {traffic.published}"
        )
