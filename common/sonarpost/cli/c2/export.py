"""`sonarpost c2 export`: what a site has accepted, in the formats of other programs."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from sonarpost.archive.shore_index import ShoreIndex
from sonarpost.cli.c2.options import add_out_dir, since_of
from sonarpost.errors import BadInputError, ConfigError
from sonarpost.export.accepted import Accepted, AcceptedContact, load_accepted
from sonarpost.export.cot import cot_events
from sonarpost.export.cot_sender import CotSender, TlsFiles
from sonarpost.export.csv_table import write_csv
from sonarpost.export.geojson import write_geojson
from sonarpost.export.kml import write_kml, write_kmz

FORMATS = ("geojson", "kml", "kmz", "csv")
EXIT_INCOMPLETE = 1


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action."""
    parser = actions.add_parser(
        "export", help="write GeoJSON, KML, KMZ or CSV, or send Cursor-on-Target events", description=__doc__
    )
    add_out_dir(parser)
    parser.add_argument("--vessel", metavar="NAME", help="of this vessel only")
    parser.add_argument("--vehicle", metavar="NAME", help="of this vehicle only")
    parser.add_argument("--since", metavar="TIME", help="first seen since then: 90m, 2h, 3d ago, or a time (UTC)")
    for name in FORMATS:
        parser.add_argument(f"--{name}", type=Path, metavar="FILE", help=f"write {name} to FILE")
    parser.add_argument("--cot", metavar="URL", help="send events to tcp://host:port, tls://… or udp://…")
    for name in ("ca", "certificate", "key"):
        parser.add_argument(f"--cot-{name}", type=Path, metavar="PEM", help=f"{name} for --cot tls://…")
    parser.add_argument(
        "--cot-wait", type=float, default=10.0, metavar="SECONDS", help="try to reach the endpoint this long (10)"
    )
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Export; return 0, or 1 if something kept could not be used and is left out.

    Raises:
        ConfigError: Nothing is asked for, or an option is wrong.
        KeptFileError: The folder cannot be read.
        OSError, PortError: A file cannot be written, events cannot be sent.
    """
    if not any(getattr(parsed, name) for name in (*FORMATS, "cot")):
        wanted = ", ".join(f"--{name}" for name in (*FORMATS, "cot"))
        raise ConfigError("c2 export", "", "nothing to write", f"at least one of {wanted}")
    accepted = _chosen(load_accepted(parsed.out_dir), parsed)
    problems = list(accepted.problems)
    writers = {"geojson": write_geojson, "kml": write_kml, "csv": write_csv}
    for name, write in writers.items():
        path: Path | None = getattr(parsed, name)
        if path is not None:
            write(path, accepted)
            _say(path, accepted)
    if parsed.kmz is not None:
        problems += write_kmz(parsed.kmz, accepted)
        _say(parsed.kmz, accepted)
    if parsed.cot is not None:
        events = cot_events(accepted, time.time())
        with CotSender(parsed.cot, TlsFiles(parsed.cot_ca, parsed.cot_certificate, parsed.cot_key)) as sender:
            sender.send(events, parsed.cot_wait)
        print(f"{parsed.cot}: {len(events)} events, {len(accepted.unlocated)} contacts without a position left out")
    _mark(parsed.out_dir, accepted.contacts)
    return _report(problems)


def _chosen(accepted: Accepted, parsed: argparse.Namespace) -> Accepted:
    since_utc_s = since_of(parsed.since)
    contacts = tuple(
        contact
        for contact in accepted.contacts
        if parsed.vessel in (None, contact.image.vessel_id)
        and parsed.vehicle in (None, contact.image.vehicle_id)
        and contact.image.first_frame_utc_s >= since_utc_s
    )
    return Accepted(contacts, accepted.unmatched, accepted.problems)


def _say(path: Path, accepted: Accepted) -> None:
    print(f"{path}: {len(accepted.contacts)} contacts, {len(accepted.unlocated)} of them without a position")


def _mark(out_dir: Path, contacts: Sequence[AcceptedContact]) -> None:
    """Note in the index what was exported: retention removes that first."""
    exported = {(c.image.vessel_id, c.image.vehicle_id, c.image.image_id, c.image.first_frame_utc_s) for c in contacts}
    try:
        index = ShoreIndex(out_dir)
        try:
            rows = [
                row
                for row in index.pictures()
                if (row.vessel_id, row.vehicle_id, row.image_id, row.first_frame_utc_s) in exported
            ]
            index.mark("exported_utc_s", rows, time.time())
        finally:
            index.close()
    except (OSError, BadInputError) as error:
        print(f"not noted as exported: {error}", file=sys.stderr)


def _report(problems: Sequence[BadInputError]) -> int:
    for problem in problems:
        print(f"left out: {problem}", file=sys.stderr)
    return EXIT_INCOMPLETE if problems else 0
