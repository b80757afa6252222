"""`sonarpost c2 watch`: a line for everything a site accepts, as it accepts it."""

from __future__ import annotations

import argparse
import json
import queue
import sys
import threading
import time
from collections.abc import Callable

import zenoh

from sonarpost import keys, wire
from sonarpost.bus.session import open_with_retry
from sonarpost.cli.c2.options import add_site, printable, time_text
from sonarpost.cli.fleet_options import add_router_options, router_of
from sonarpost.errors import PayloadError
from sonarpost.messages import Decision, ReconstructedImage, Record, TaskingState

LOOK_S = 0.2
GONE_AFTER_S = 1.0
ReadLine = tuple[str, bytes]


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser("watch", help="print a line for everything that is accepted, live; Ctrl-C ends it")
    add_site(parser)
    add_router_options(parser)
    parser.add_argument("--vessel", metavar="NAME", help="of this vessel only")
    parser.add_argument("--json", action="store_true", help="one JSON object a line")
    parser.add_argument("--count", type=int, metavar="N", help="end after N lines")
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Print until interrupted, or until `--count` lines were printed; return 0."""
    endpoints, tls = router_of(parsed)
    stop = threading.Event()
    session = open_with_retry(endpoints, stop, tls)
    assert session is not None
    try:
        _say(f"watching {parsed.site} at {', '.join(endpoints)}")
        Watch(session, parsed.site, parsed.vessel).run(_printer(as_json=parsed.json), parsed.count, stop)
    except KeyboardInterrupt:
        return 0
    finally:
        stop.set()
        session.close()
    return 0


class Watch:
    """Subscribes to what a site shows; a session finds back to its router by itself, and says so here.

    Args:
        session: Of the site's router.
        site: The site.
        vessel: Of this vessel only; None for all.
    """

    def __init__(self, session: zenoh.Session, site: str, vessel: str | None) -> None:
        self._session = session
        self._vessel = vessel
        self._site = site
        self._samples: queue.Queue[ReadLine] = queue.Queue()
        for key in (keys.shore_contact_all(site), keys.tasking_state_all(site)):
            session.declare_subscriber(key, self._on_sample)
        self._gone_since_s: float | None = None
        self._told_gone = False

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._samples.put((str(sample.key_expr), sample.payload.to_bytes()))

    def run(self, show: Callable[[Record], None], count: int | None, stop: threading.Event) -> None:
        """Show records until `stop` is set or `count` of them were shown."""
        shown = 0
        while not stop.is_set() and (count is None or shown < count):
            self._look_at_link()
            try:
                key, payload = self._samples.get(timeout=LOOK_S)
            except queue.Empty:
                continue
            record = self._read(key, payload)
            if record is not None and self._vessel in (None, record.vessel_id):
                show(record)
                shown += 1

    def _read(self, key: str, payload: bytes) -> ReconstructedImage | Decision | TaskingState | None:
        kinds: dict[str, type[ReconstructedImage] | type[Decision] | type[TaskingState]] = {
            "image": ReconstructedImage,
            "decision": Decision,
            "state": TaskingState,
        }
        kind = kinds.get(key.rpartition("/")[2])
        if kind is None:
            return None
        try:
            return wire.decode(kind, payload, key)
        except PayloadError as error:
            _say(str(error))
            return None

    def _look_at_link(self) -> None:
        """Say when the router is gone and when it is back; what was shown meanwhile is in `ls`."""
        if self._session.info.routers_zid():
            if self._told_gone:
                _say("router back; what was accepted meanwhile is in `sonarpost c2 ls`")
            self._gone_since_s, self._told_gone = None, False
            return
        now_s = time.monotonic()
        if self._gone_since_s is None:
            self._gone_since_s = now_s
        elif not self._told_gone and now_s - self._gone_since_s > GONE_AFTER_S:
            self._told_gone = True
            _say("router not reached, trying again")


def _printer(*, as_json: bool) -> Callable[[Record], None]:
    def show(record: Record) -> None:
        print(json.dumps(_fields(record)) if as_json else printable(line_of(record)), flush=True)

    return show


def _fields(record: Record) -> dict[str, object]:
    without = {"picture", "missing_mask"} if isinstance(record, ReconstructedImage) else set[str]()
    return {"type": record.TYPE, **record.model_dump(exclude=without)}


def line_of(record: Record) -> str:
    """Return the line for people."""
    if isinstance(record, ReconstructedImage):
        contact = record.contact
        parts = [f"{record.picture.width_px} x {record.picture.height_px} px"]
        parts.append("complete" if record.complete else f"{100 * record.missing_fraction:.0f} % missing")
        if contact is not None and contact.lat_deg is not None and contact.lon_deg is not None:
            parts.append(f"at {contact.lat_deg:.5f} {contact.lon_deg:.5f}")
        name = f"{record.vehicle_id}/{record.image_id} v{record.version}"
        return f"{time_text(record.last_frame_utc_s)}  {record.vessel_id}  picture   {name}  {', '.join(parts)}"
    if isinstance(record, Decision):
        name = f"{record.vehicle_id}/{record.image_id} v{record.image_version}"
        words = " ".join(part for part in (record.verdict, record.mlo_class or "", record.remark) if part)
        return f"{time_text(record.decided_utc_s)}  {record.vessel_id}  decision  {name}  {words} ({record.operator})"
    assert isinstance(record, TaskingState)
    reason = f": {record.reason}" if record.reason else ""
    what = f"{record.kind:8}  {record.record_id}  {record.state}{reason}"
    return f"{time_text(record.changed_utc_s)}  {record.vessel_id}  {what}"


def _say(text: str) -> None:
    print(f"sonarpost c2: {text}", file=sys.stderr, flush=True)
