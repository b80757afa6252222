"""`sonarpost c2 advise` and `sonarpost c2 task`: what the shore says to a vessel, handed to c2 for good."""

from __future__ import annotations

import argparse
import getpass
import threading
import time
import uuid
from typing import get_args

import zenoh
from pydantic import ValidationError

from sonarpost import keys
from sonarpost.bus.session import open_with_retry
from sonarpost.cli.c2.options import add_site
from sonarpost.cli.fleet_options import add_router_options, router_of
from sonarpost.delivery.client import deliver
from sonarpost.errors import ConfigError, PortError
from sonarpost.messages import Advice, Command, CommandKind, Record, Verdict
from sonarpost.wire import expected_text

CONSUMER = "c2"


def add_action(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add both actions."""
    advise = actions.add_parser("advise", help="tell a vessel's operator what an expert ashore thinks of a picture")
    _add_common(advise)
    advise.add_argument("--version", type=int, default=1, metavar="N", help="of the picture (default: 1)")
    advise.add_argument("--verdict", choices=get_args(Verdict))
    advise.add_argument("--confidence", type=float, metavar="P", help="0 to 1")
    advise.add_argument("--class", dest="mlo_class", metavar="TEXT", help="class of mine-like object")
    advise.add_argument("--remark", default="", metavar="TEXT")
    advise.set_defaults(run=run_advise)
    task = actions.add_parser("task", help="ask a vehicle for more detail, for a picture again, or to go somewhere")
    _add_common(task)
    task.add_argument("--kind", required=True, choices=get_args(CommandKind))
    task.add_argument("--lat", type=float, metavar="DEG", help="where to revisit")
    task.add_argument("--lon", type=float, metavar="DEG", help="where to revisit")
    task.set_defaults(run=run_task)


def _add_common(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("picture", metavar="VEHICLE[/IMAGE]", help="as `ls` shows it")
    parser.add_argument("--vessel", required=True, metavar="NAME", help="whom to tell")
    parser.add_argument("--author", default=None, metavar="NAME", help="who says so (default: the user's name)")
    parser.add_argument("--id", metavar="TEXT", help="identifier; with the same one a record is taken once")
    parser.add_argument("--timeout", type=float, default=10.0, metavar="S", help="to reach c2 (default: 10)")
    add_site(parser)
    add_router_options(parser)


def run_advise(parsed: argparse.Namespace) -> int:
    """Hand advice to c2; return 0 when it is on c2's disk.

    Raises:
        ConfigError: An option is wrong.
        PayloadError: c2 refuses it.
        HandoffError, PortError: c2 or its router is not reached in time.
    """
    vehicle, image = _picture(parsed)
    advice_id = parsed.id or _new_id("a")
    fields = {
        "advice_id": advice_id,
        "vessel_id": parsed.vessel,
        "vehicle_id": vehicle,
        "image_id": image,
        "image_version": parsed.version,
        "verdict": parsed.verdict,
        "confidence": parsed.confidence,
        "mlo_class": parsed.mlo_class,
        "remark": parsed.remark,
        "author": _author(parsed),
        "advised_utc_s": time.time(),
    }
    advice = _made(Advice, fields)
    _hand_in(parsed, keys.tasking_advice(parsed.vessel, parsed.site), advice)
    print(f"advice {advice_id} for {parsed.vessel} accepted; `sonarpost c2 ls --tasking` shows how far it has come")
    return 0


def run_task(parsed: argparse.Namespace) -> int:
    """Hand a command to c2; return 0 when it is on c2's disk.

    Raises:
        ConfigError, PayloadError, HandoffError, PortError: As `run_advise`.
    """
    vehicle, image = _picture(parsed)
    command_id = parsed.id or _new_id("c")
    fields = {
        "command_id": command_id,
        "kind": parsed.kind,
        "vehicle_id": vehicle,
        "image_id": image,
        "lat_deg": parsed.lat,
        "lon_deg": parsed.lon,
        "issued_by": _author(parsed),
        "issued_utc_s": time.time(),
    }
    command = _made(Command, fields)
    _hand_in(parsed, keys.tasking_command(parsed.vessel, parsed.site), command)
    print(f"command {command_id} for {parsed.vessel} accepted; `sonarpost c2 ls --tasking` shows how far it has come")
    return 0


def _picture(parsed: argparse.Namespace) -> tuple[str, str | None]:
    vehicle, _, image = parsed.picture.partition("/")
    return vehicle, image or None


def _author(parsed: argparse.Namespace) -> str:
    if parsed.author is not None:
        return str(parsed.author)
    try:
        return getpass.getuser()
    except (KeyError, OSError) as error:
        raise ConfigError("c2", "--author", "nothing", "a name: this host does not know the user's") from error


def _new_id(letter: str) -> str:
    return f"{letter}-{uuid.uuid4().hex}"


def _made(record_type: type[Record], fields: dict[str, object]) -> Record:
    try:
        return record_type.model_validate(fields)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(str(part) for part in first["loc"])
        raise ConfigError("c2", name, first["input"], expected_text(first["type"], first["msg"])) from error


def _hand_in(parsed: argparse.Namespace, key: str, record: Record) -> None:
    endpoints, tls = router_of(parsed)
    give_up = threading.Event()
    timer = threading.Timer(parsed.timeout, give_up.set)
    timer.daemon = True
    timer.start()
    session: zenoh.Session | None = None
    try:
        session = open_with_retry(endpoints, give_up, tls)
        if session is None:
            raise PortError(f"{', '.join(endpoints)}: no router answered within {parsed.timeout:g} s")
        deliver(session, key, CONSUMER, record, parsed.timeout)
    finally:
        timer.cancel()
        if session is not None:
            session.close()
