"""`python -m research.single_record`: latency and processor time of single records from a vessel to its shore site.

    python -m research.single_record [--records 300] [--rate 10] [--kind decision|image] [--dir DIR]

Real processes: the router and the relay of a vessel, the router and c2 of the shore site. This process hands over one
record after the other with the delivery client, as commands do, and subscribes at the shore site. An image counts when
c2 publishes it in coded form, before it is decoded. All times are in milliseconds:

- `accepted_*`: until the relay has acknowledged the record, which is then on its disk;
- `shown_*`: until the subscriber at the shore site receives it, which is then on the disk of c2;
- `cpu`: processor time for each record, less that of an equal time without records (`idle`, for each second).

One JSON object; the exit status is 0 if the subscriber has received each record once.
"""

import argparse
import json
import os
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable
from pathlib import Path

import msgpack
import zenoh

from research.fleet import Processes, coded_image, fleet, open_session, percentiles, wait_until_ready
from research.relay_throughput import VESSEL, decision
from sonarpost import keys
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.delivery.client import deliver
from sonarpost.messages import CodedImage, Decision

WARM_UP = 20
"""Records before the measurement, in which files and queues are created."""
TIMEOUT_S = 30.0
SERVICES = ("relay", "c2", f"router-{VESSEL}", "router-shore")


def new_image(number: int) -> CodedImage:
    """Return a coded image."""
    return coded_image(VESSEL, 1, number, time.time())


class Arrivals:
    """Times at which a subscriber receives the records of a type first."""

    def __init__(self, record_type: str, name: str) -> None:
        self._record_type = record_type
        self._name = name
        self._condition = threading.Condition()
        self.at_s: dict[str, float] = {}
        self.again = 0

    def receive(self, sample: zenoh.Sample) -> None:
        """Note a record."""
        now_s = time.perf_counter()
        fields = msgpack.unpackb(sample.payload.to_bytes())
        if fields["type"] != self._record_type:
            return
        with self._condition:
            if self.at_s.setdefault(fields[self._name], now_s) != now_s:
                self.again += 1
            self._condition.notify_all()

    def wait(self, count: int) -> None:
        """Wait until this number of records has arrived, at most `TIMEOUT_S`."""
        with self._condition:
            self._condition.wait_for(lambda: len(self.at_s) >= count, TIMEOUT_S)


def cpu_ms(processes: Processes) -> dict[str, float]:
    """Return the processor time of each service, including its decoders."""
    used = {name: 1000 * processes.cpu_s(name) for name in SERVICES}
    used["decoders"] = 1000 * processes.children_cpu_s("c2")
    return used


def used_since(processes: Processes, before: dict[str, float], divisor: float) -> dict[str, float]:
    """Return the processor time of each service since `before`, divided."""
    return {name: (ms - before[name]) / divisor for name, ms in cpu_ms(processes).items()}


def measure(folder: Path, records: int, rate_per_s: float, kind: str) -> dict[str, object]:
    """Hand over records; return the figures."""
    make: Callable[[int], CodedImage | Decision] = new_image if kind == "image" else decision
    key = keys.image_coded(VESSEL) if kind == "image" else keys.contact_decision(VESSEL)
    name = "image_id" if kind == "image" else "decision_id"
    arrivals = Arrivals(make(0).TYPE, name)
    duration_s = records / rate_per_s
    with fleet(folder, [VESSEL], start_relays=False) as (processes, endpoints, shore):
        command = ("-m", "sonarpost.services.relay", "--config", str(folder / f"{VESSEL}.toml"))
        processes.start("relay", *command)
        subscriber, publisher = open_session(shore), open_session(endpoints[VESSEL])
        subscriber.declare_subscriber(keys.shore_contact_all(), arrivals.receive)
        wait_until_ready(subscriber, [VESSEL])
        origin = uuid.uuid4().bytes
        for number in range(1, WARM_UP + 1):
            deliver(publisher, key, "relay", make(number), TIMEOUT_S, origin=origin, seq=number)
        arrivals.wait(WARM_UP)
        time.sleep(2.0)
        before = cpu_ms(processes)
        time.sleep(duration_s)
        idle = used_since(processes, before, duration_s)
        before = cpu_ms(processes)
        accepted_s: list[float] = []
        shown_s: dict[str, float] = {}
        started_s = time.perf_counter()
        for number in range(WARM_UP + 1, WARM_UP + 1 + records):
            time.sleep(max(0.0, started_s + (number - WARM_UP) / rate_per_s - time.perf_counter()))
            record = make(number)
            began_s = time.perf_counter()
            deliver(publisher, key, "relay", record, TIMEOUT_S, origin=origin, seq=number)
            accepted_s.append(time.perf_counter() - began_s)
            shown_s[getattr(record, name)] = began_s
        arrivals.wait(WARM_UP + records)
        # The last acknowledgement and the decoding follow the publication.
        time.sleep(1.0)
        used = used_since(processes, before, records)
        ran_s = time.perf_counter() - started_s
        publisher.close()
        subscriber.close()
    latency_s = [arrivals.at_s[record] - at_s for record, at_s in shown_s.items() if record in arrivals.at_s]
    cpu = {service: round(ms - idle[service] * ran_s / records, 2) for service, ms in used.items()}
    return {
        "record": make(0).TYPE,
        "records": records,
        "rate_per_s": rate_per_s,
        **percentiles("accepted", accepted_s),
        **percentiles("shown", latency_s),
        "cpu": {"all": round(sum(ms for service, ms in cpu.items() if service != "decoders"), 2), **cpu},
        "idle": {"all": round(sum(idle.values()), 2), **{service: round(ms, 2) for service, ms in idle.items()}},
        "load_average": round(os.getloadavg()[0], 1),
        "good": len(latency_s) == records and not arrivals.again,
    }


def main() -> int:
    """Run; return 1 if a record is missing or repeated."""
    parser = argparse.ArgumentParser(description="latency and processor time of single records, vessel to shore")
    parser.add_argument("--records", type=int, default=300, metavar="N", help="default: 300")
    parser.add_argument("--rate", type=float, default=10.0, metavar="R", help="records a second; default: 10")
    parser.add_argument("--kind", choices=("decision", "image"), default="decision", help="default: decision")
    parser.add_argument("--dir", type=Path, metavar="DIR", help="folder for stores and files (default: temporary)")
    args = parser.parse_args()
    with ProgressDisplay(step="single_record"), tempfile.TemporaryDirectory(dir=args.dir) as name:
        result = measure(Path(name), args.records, args.rate, args.kind)
    print(json.dumps(result), flush=True)
    return 0 if result["good"] else 1


if __name__ == "__main__":
    sys.exit(main())
