"""`sonarpost c2 command` and `comment`: send a command for a vehicle or an expert's comment through c2 to a vessel."""

from __future__ import annotations

import argparse
import getpass
import threading
import time
import uuid
from typing import get_args

from pydantic import ValidationError

from sonarpost import keys
from sonarpost.bus.session import open_with_retry
from sonarpost.cli.shared import Subparsers, add_router_options, add_site_option, router_of
from sonarpost.delivery.client import deliver
from sonarpost.errors import ConfigError, PortError
from sonarpost.messages import Command, CommandKind, Comment, QueuePlace, Record, Verdict
from sonarpost.wire import first_error

CONSUMER = "c2"


def add_actions(actions: Subparsers) -> None:
    """Add the actions `command` and `comment`."""
    command = actions.add_parser(
        "command", help="request more detail, a lost image part, more seabed, the unfiltered image or a revisit"
    )
    _add_common_options(command)
    command.add_argument(
        "--kind",
        required=True,
        choices=get_args(CommandKind),
        metavar="KIND",
        help="refine (more detail), resend (lost parts), expand (more seabed around the contact), original (the image"
        " without despeckling), region (a part of the image), prioritise (move it in the transmit queue) or revisit",
    )
    command.add_argument("--lat", type=float, metavar="DEG", help="latitude to revisit")
    command.add_argument("--lon", type=float, metavar="DEG", help="longitude to revisit")
    command.add_argument(
        "--box",
        type=int,
        nargs=4,
        metavar=("TOP", "LEFT", "BOTTOM", "RIGHT"),
        help="edges of the region in 1/32 of the sides of the image",
    )
    command.add_argument("--bytes", type=int, metavar="N", help="length of the stream of the region")
    command.add_argument("--place", choices=get_args(QueuePlace), help="place in the transmit queue")
    command.set_defaults(run=run_command)
    comment = actions.add_parser("comment", help="send an expert's comment on an image to the operator of a vessel")
    _add_common_options(comment)
    comment.add_argument("--version", type=int, default=1, metavar="N", help="version of the image (default: 1)")
    comment.add_argument("--verdict", choices=get_args(Verdict), help="verdict of the expert")
    comment.add_argument("--confidence", type=float, metavar="P", help="0 to 1")
    comment.add_argument("--class", dest="mlo_class", metavar="TEXT", help="class of mine-like object")
    comment.add_argument("--remark", default="", metavar="TEXT", help="free text")
    comment.set_defaults(run=run_comment)


def _add_common_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("image", metavar="VEHICLE[/IMAGE]", help="name from `ls`")
    parser.add_argument("--vessel", required=True, metavar="NAME", help="vessel to send to")
    parser.add_argument("--author", default=None, metavar="NAME", help="author (default: login name)")
    parser.add_argument("--id", metavar="TEXT", help="identifier; c2 accepts a record with one identifier once")
    parser.add_argument("--timeout", type=float, default=10.0, metavar="S", help="time limit to reach c2 (default: 10)")
    add_site_option(parser)
    add_router_options(parser)


def run_comment(parsed: argparse.Namespace) -> int:
    """Send a comment to c2; return 0 after c2 has stored it."""
    vehicle, image = _vehicle_and_image(parsed)
    fields = {
        "comment_id": parsed.id or f"a-{uuid.uuid4().hex}",
        "vessel_id": parsed.vessel,
        "vehicle_id": vehicle,
        "image_id": image,
        "image_version": parsed.version,
        "verdict": parsed.verdict,
        "confidence": parsed.confidence,
        "mlo_class": parsed.mlo_class,
        "remark": parsed.remark,
        "author": _author(parsed),
        "commented_utc_s": time.time(),
    }
    _send(parsed, keys.tasking_comment(parsed.vessel, parsed.site), Comment, fields)
    _print_accepted("comment", fields["comment_id"], parsed.vessel)
    return 0


def run_command(parsed: argparse.Namespace) -> int:
    """Send a command to c2; return 0 after c2 has stored it."""
    vehicle, image = _vehicle_and_image(parsed)
    fields = {
        "command_id": parsed.id or f"c-{uuid.uuid4().hex}",
        "kind": parsed.kind,
        "vehicle_id": vehicle,
        "image_id": image,
        "lat_deg": parsed.lat,
        "lon_deg": parsed.lon,
        "issued_by": _author(parsed),
        "issued_utc_s": time.time(),
        "box": None if parsed.box is None else tuple(parsed.box),
        "stream_bytes": parsed.bytes,
        "place": parsed.place,
    }
    _send(parsed, keys.tasking_command(parsed.vessel, parsed.site), Command, fields)
    _print_accepted("command", fields["command_id"], parsed.vessel)
    return 0


def _print_accepted(noun: str, record_id: object, vessel: str) -> None:
    print(f"{noun} {record_id} for {vessel} accepted; `sonarpost c2 ls --tasking` shows its delivery state")


def _vehicle_and_image(parsed: argparse.Namespace) -> tuple[str, str | None]:
    vehicle, _, image = parsed.image.partition("/")
    return vehicle, image or None


def _author(parsed: argparse.Namespace) -> str:
    if parsed.author is not None:
        return str(parsed.author)
    try:
        return getpass.getuser()
    except (KeyError, OSError) as error:
        raise ConfigError("c2", "--author", "nothing", "a name: the login name is unknown") from error


def _send(parsed: argparse.Namespace, key: str, record_type: type[Record], fields: dict[str, object]) -> None:
    """Validate a record and deliver it to c2."""
    try:
        record = record_type.model_validate(fields)
    except ValidationError as error:
        raise ConfigError("c2", *first_error(error)) from error
    endpoints, tls = router_of(parsed)
    timed_out = threading.Event()
    timer = threading.Timer(parsed.timeout, timed_out.set)
    timer.daemon = True
    timer.start()
    try:
        session = open_with_retry(endpoints, timed_out, tls)
        if session is None:
            raise PortError(f"{', '.join(endpoints)}: no router answered within {parsed.timeout:g} s")
        with session:
            deliver(session, key, CONSUMER, record, parsed.timeout)
    finally:
        timer.cancel()
