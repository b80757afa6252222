"""`sonarpost c2 command` and `comment`: send a command for a vehicle or an expert's comment through c2 to a vessel."""

import argparse
import getpass
import threading
import time
import uuid
from typing import get_args

from pydantic import ValidationError

from sonarpost import keys
from sonarpost.bus.session import open_with_retry
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import add_router_options, add_site_option, option, router_of
from sonarpost.delivery.client import deliver
from sonarpost.errors import ConfigError, PortError
from sonarpost.messages import Command, CommandKind, Comment, QueuePlace, Record, Verdict
from sonarpost.wire import first_error

CONSUMER = "c2"


def add_actions(parser: CommandParser) -> None:
    """Add the actions `command` and `comment`."""
    command = parser.add_action(
        "command",
        "request more detail, a lost image part, more seabed, the unfiltered image or a revisit",
        run_command,
        "uuv-1/0001 --vessel vessel-1 --kind refine",
    )
    _add_common_options(command)
    option(
        command,
        "--kind KIND",
        "refine (more detail), resend (lost parts), expand (more seabed around the contact), original (the image"
        " without despeckling), region (a part of the image), prioritise (move it in the transmit queue) or revisit",
        required=True,
        choices=get_args(CommandKind),
    )
    option(command, "--lat DEG", "latitude to revisit", float)
    option(command, "--lon DEG", "longitude to revisit", float)
    option(
        command, "--box TOP LEFT BOTTOM RIGHT", "edges of the region in 1/32 of the sides of the image", int, nargs=4
    )
    option(command, "--bytes N", "length of the stream of the region", int)
    option(command, "--place", "place in the transmit queue", choices=get_args(QueuePlace))
    comment = parser.add_action(
        "comment",
        "send an expert's comment on an image to the operator of a vessel",
        run_comment,
        "uuv-1/0001 --vessel vessel-1 --verdict mine_like --remark 'same as last year'",
    )
    _add_common_options(comment)
    option(comment, "--version N", "version of the image", int, 1)
    option(comment, "--verdict", "verdict of the expert", choices=get_args(Verdict))
    option(comment, "--confidence P", "0 to 1", float)
    option(comment, "--class TEXT", "class of mine-like object", dest="mlo_class")
    option(comment, "--remark TEXT", "free text", default="")


def _add_common_options(parser: argparse.ArgumentParser) -> None:
    option(parser, "image VEHICLE[/IMAGE]", "name from `ls`")
    option(parser, "--vessel NAME", "vessel to send to", required=True)
    option(parser, "--author NAME", "author (default: login name)", default=None)
    option(parser, "--id TEXT", "identifier; c2 accepts a record with one identifier once")
    option(parser, "--timeout S", "time limit to reach c2", float, 10.0)
    add_site_option(parser)
    add_router_options(parser)


def run_comment(parsed: argparse.Namespace) -> int:
    """Send a comment to c2; return 0 after c2 has stored it."""
    fields = {
        "comment_id": parsed.id or f"a-{uuid.uuid4().hex}",
        "vessel_id": parsed.vessel,
        "image_version": parsed.version,
        "verdict": parsed.verdict,
        "confidence": parsed.confidence,
        "mlo_class": parsed.mlo_class,
        "remark": parsed.remark,
        "author": _author(parsed),
        "commented_utc_s": time.time(),
    }
    return _send(parsed, "comment", keys.tasking_comment(parsed.vessel, parsed.site), Comment, fields)


def run_command(parsed: argparse.Namespace) -> int:
    """Send a command to c2; return 0 after c2 has stored it."""
    fields = {
        "command_id": parsed.id or f"c-{uuid.uuid4().hex}",
        "kind": parsed.kind,
        "lat_deg": parsed.lat,
        "lon_deg": parsed.lon,
        "issued_by": _author(parsed),
        "issued_utc_s": time.time(),
        "box": None if parsed.box is None else tuple(parsed.box),
        "stream_bytes": parsed.bytes,
        "place": parsed.place,
    }
    return _send(parsed, "command", keys.tasking_command(parsed.vessel, parsed.site), Command, fields)


def _author(parsed: argparse.Namespace) -> str:
    if parsed.author is not None:
        return str(parsed.author)
    try:
        return getpass.getuser()
    except (KeyError, OSError) as error:
        raise ConfigError("c2", "--author", "nothing", "a name: the login name is unknown") from error


def _send(parsed: argparse.Namespace, noun: str, key: str, record_type: type[Record], fields: dict[str, object]) -> int:
    """Validate a record and deliver it to c2; return 0."""
    vehicle, _, image = parsed.image.partition("/")
    try:
        record = record_type.model_validate({**fields, "vehicle_id": vehicle, "image_id": image or None})
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
    record_id = fields[f"{noun}_id"]
    print(f"{noun} {record_id} for {parsed.vessel} accepted; `sonarpost c2 ls --tasking` shows its delivery state")
    return 0
