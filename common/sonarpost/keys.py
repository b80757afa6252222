"""Every Zenoh key expression of sonarpost. No other module spells one.

Grammar: `sonarpost/v1/{platform}/…`. One prefix a platform, so that access control is a rule on a prefix; identifiers
of contacts and images stay in the payloads.
"""

from __future__ import annotations

import re

from sonarpost.errors import BadInputError

ROOT = "sonarpost/v1"
SHORE = "shore"
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,39}")


def _name(field: str, value: str) -> str:
    if not _NAME.fullmatch(value):
        raise BadInputError(
            "key expression", field, value, "1 to 40 of a-z, 0-9, '-' and '_', the first a letter or digit"
        )
    return value


def _of(platform: str, rest: str) -> str:
    return f"{ROOT}/{_name('platform', platform)}/{rest}"


def contact_detected(vehicle: str) -> str:
    """Contact and snippet, atd_stub to compressor (the paper's imgToCompress)."""
    return _of(vehicle, "contact/detected")


def image_encoded(vehicle: str) -> str:
    """Encoded image, compressor to uuv_modem (imgToDecompress, UUV side)."""
    return _of(vehicle, "image/encoded")


def acoustic_tx(platform: str) -> str:
    """Frames that left through this platform's modem."""
    return _of(platform, "acoustic/tx")


def acoustic_rx(platform: str) -> str:
    """Frames that this platform's modem received, op_modem to decompressor."""
    return _of(platform, "acoustic/rx")


def acoustic_queue(platform: str) -> str:
    """What waits to be sent through this platform's modem, and until when."""
    return _of(platform, "acoustic/queue")


def acoustic_queue_everywhere() -> str:
    """What waits at every modem that is reached."""
    return f"{ROOT}/*/acoustic/queue"


def acoustic_downlink(vessel: str) -> str:
    """How far commands and decisions have come on their way to the vehicles."""
    return _of(vessel, "acoustic/downlink")


def message_received(vessel: str) -> str:
    """Messages of vehicles that came by sound, op_modem to the vessel's programs."""
    return _of(vessel, "message/received")


def message_outgoing(vehicle: str) -> str:
    """Other traffic for the acoustic queue, any program to uuv_modem."""
    return _of(vehicle, "message/outgoing")


def image_reconstructed(vessel: str) -> str:
    """Rebuilt picture, decompressor to relay and console (imgToDecompress, operator side)."""
    return _of(vessel, "image/reconstructed")


def contact_decision(vessel: str) -> str:
    """An operator's decision, to relay and op_modem."""
    return _of(vessel, "contact/decision")


def command(platform: str, kind: str) -> str:
    """A command: asked on the vessel, carried by sound, published on the vehicle."""
    return _of(platform, f"command/{_name('kind', kind)}")


def command_all(platform: str) -> str:
    """Commands of every kind."""
    return _of(platform, "command/*")


def advice(vessel: str) -> str:
    """An expert's advice: c2 to relay, relay to the consumers on the vessel."""
    return _of(vessel, "advice")


def shore_inbox(vessel: str, site: str = SHORE) -> str:
    """Records relayed from one vessel to one site, relay to c2."""
    return _of(site, f"inbox/{_name('vessel', vessel)}")


def shore_inbox_all(site: str = SHORE) -> str:
    """Records relayed from every vessel to one site."""
    return _of(site, "inbox/*")


def shore_image(vessel: str, site: str = SHORE) -> str:
    """What a site's c2 has accepted of one vessel's pictures, for every shore subscriber."""
    return _of(site, f"contact/{_name('vessel', vessel)}/image")


def shore_decision(vessel: str, site: str = SHORE) -> str:
    """What a site's c2 has accepted of one vessel's decisions, for every shore subscriber."""
    return _of(site, f"contact/{_name('vessel', vessel)}/decision")


def shore_image_all(site: str = SHORE) -> str:
    """What a site's c2 has accepted of every vessel's pictures."""
    return _of(site, "contact/*/image")


def shore_decision_all(site: str = SHORE) -> str:
    """What a site's c2 has accepted of every vessel's decisions."""
    return _of(site, "contact/*/decision")


def shore_contact_all(site: str = SHORE) -> str:
    """Everything a site's c2 has accepted, of every vessel."""
    return _of(site, "contact/*/*")


def tasking_advice(vessel: str, site: str = SHORE) -> str:
    """Advice for one vessel, a console or command ashore to c2."""
    return _of(site, f"tasking/{_name('vessel', vessel)}/advice")


def tasking_advice_all(site: str = SHORE) -> str:
    """Advice for every vessel."""
    return _of(site, "tasking/*/advice")


def tasking_command(vessel: str, site: str = SHORE) -> str:
    """A command for a vehicle of one vessel, a console or command ashore to c2."""
    return _of(site, f"tasking/{_name('vessel', vessel)}/command")


def tasking_command_all(site: str = SHORE) -> str:
    """Commands for the vehicles of every vessel."""
    return _of(site, "tasking/*/command")


def tasking_vessel(key: str) -> str:
    """Return the vessel that a key made by `tasking_advice` or `tasking_command` names.

    Raises:
        BadInputError: It is no such key.
    """
    parts = key.split("/")
    if len(parts) != 6 or not key.startswith(f"{ROOT}/") or parts[3] != "tasking":
        raise BadInputError(key, "", key, f"{ROOT}/{{site}}/tasking/{{vessel}}/…")
    return _name("vessel", parts[4])


def tasking_state(vessel: str, site: str = SHORE) -> str:
    """How far advice and commands for one vessel have come, for every shore subscriber."""
    return _of(site, f"tasking/{_name('vessel', vessel)}/state")


def tasking_state_all(site: str = SHORE) -> str:
    """How far advice and commands for every vessel have come."""
    return _of(site, "tasking/*/state")


def health(platform: str, service: str) -> str:
    """A service's health record."""
    return _of(platform, f"health/{_name('service', service)}")


def health_all(platform: str) -> str:
    """Health of every service of a platform."""
    return _of(platform, "health/*")


def health_everywhere() -> str:
    """Health of every service of every platform."""
    return f"{ROOT}/*/health/*"


def alive(platform: str, service: str) -> str:
    """A service's liveliness token."""
    return _of(platform, f"alive/{_name('service', service)}")


def alive_everywhere() -> str:
    """Liveliness tokens of every service of every platform."""
    return f"{ROOT}/*/alive/*"


def service_of(key: str) -> tuple[str, str]:
    """Return platform and service of a health key or a liveliness token.

    Raises:
        BadInputError: It is neither.
    """
    parts = key.removeprefix(f"{ROOT}/").split("/")
    if not key.startswith(f"{ROOT}/") or len(parts) != 3 or parts[1] not in ("health", "alive"):
        raise BadInputError(key, "", key, f"{ROOT}/{{platform}}/health or alive/{{service}}")
    return _name("platform", parts[0]), _name("service", parts[2])


def delivery_query(key: str, consumer: str) -> str:
    """Where the named consumer answers hand-over queries for the records of `key`."""
    return f"{key}/handoff/{_name('consumer', consumer)}"


def delivery_query_any(key: str) -> str:
    """Where any consumer answers hand-over queries for the records of `key`."""
    return f"{key}/handoff/*"


def hello(vessel: str, answerer: str, site: str = SHORE) -> str:
    """Where one process of a site says to a vessel that it is there."""
    return f"{shore_inbox(vessel, site)}/hello/{_name('answerer', answerer)}"


def hello_from_anybody(vessel: str, site: str = SHORE) -> str:
    """Where every process of a site that says so says to a vessel that it is there."""
    return f"{shore_inbox(vessel, site)}/hello/*"


def hello_to_all(answerer: str, site: str = SHORE) -> str:
    """Where one process of a site says to every vessel that it is there."""
    return f"{shore_inbox_all(site)}/hello/{_name('answerer', answerer)}"


def below(key: str) -> str:
    """A key and everything below it, for access control."""
    return f"{key}/**"


def everything_of(platform: str) -> str:
    """Whatever one platform says, for access control."""
    return _of(platform, "**")


def everything() -> str:
    """Whatever anybody of sonarpost says, for access control."""
    return f"{ROOT}/**"


# Zenoh's own tools and REST interface ask a router about itself there; `**` does not match it.
ROUTER_ADMINISTRATION = "@/**"
ANY = "**"
