"""All Zenoh key expressions of sonarpost.

Grammar: `sonarpost/v1/{platform}/…`. Each platform has one prefix, so that access control is a rule on a prefix.
Identifiers of contacts and images are in the payloads. Each sentence group `Record: … From: … To: … Delivery: …`
of a docstring is a row of the generated table of keys.
"""

from __future__ import annotations

import functools
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


def _vessel_in(key: str, form: str) -> str:
    """Return the vessel in a key of the form `sonarpost/v1/{site}/word/{vessel}/word`; `…` stands for any word."""
    parts, words = key.split("/"), form.split("/")
    fits = len(parts) == len(words) and all(parts[i] == words[i] or words[i] == "…" for i in (0, 1, 3, 5))
    if not fits:
        raise BadInputError(key, "", key, form)
    return _name("vessel", parts[4])


def contact_detected(vehicle: str) -> str:
    """A contact and its snippet (the paper's imgToCompress).

    Record: snippet. From: atd_stub. To: compressor. Delivery: durable, priority 4.
    """
    return _of(vehicle, "contact/detected")


def image_encoded(vehicle: str) -> str:
    """An encoded image (the paper's imgToDecompress on the vehicle).

    Record: encoded_image. From: compressor. To: uuv_modem. Delivery: durable, priority 4.
    """
    return _of(vehicle, "image/encoded")


def acoustic_tx(platform: str) -> str:
    """A frame that this platform's modem transmitted.

    Record: acoustic_frame. From: uuv_modem, op_modem. To: watchers. Delivery: plain, priority 5.
    """
    return _of(platform, "acoustic/tx")


def acoustic_rx(platform: str) -> str:
    """A frame that this platform's modem received.

    Record: acoustic_frame. From: op_modem. To: watchers. Delivery: plain, priority 5.
    """
    return _of(platform, "acoustic/rx")


def vessel_frames(lead: str, vessel: str) -> str:
    """A frame of a vehicle that a vessel received, for the lead vessel that merges it with its own.

    Record: acoustic_frame. From: op_modem. To: op_modem. Delivery: durable, priority 4, not published.
    """
    return _of(lead, f"inbox/{_name('vessel', vessel)}/frame")


def frames_vessel(key: str) -> str:
    """Return the vessel that a key made by `vessel_frames` names.

    Raises:
        BadInputError: It is another key.
    """
    return _vessel_in(key, f"{ROOT}/{{lead}}/inbox/{{vessel}}/frame")


def acoustic_image(vessel: str) -> str:
    """The coded content of an image, after more of it arrived.

    Record: received_image. From: op_modem. To: decompressor. Delivery: durable, priority 4.
    """
    return _of(vessel, "acoustic/image")


def acoustic_queue(platform: str) -> str:
    """The state of the vehicle's acoustic transmit queue.

    Record: queue_state. From: uuv_modem. To: atd_stub, watchers. Delivery: plain, priority 5.
    """
    return _of(platform, "acoustic/queue")


def acoustic_queue_everywhere() -> str:
    """The transmit queues of all vehicles."""
    return f"{ROOT}/*/acoustic/queue"


def vehicle_status(vehicle: str) -> str:
    """The position and state of the vehicle.

    uuv_modem sends the latest one at intervals if `status_period_s` is set.

    Record: vehicle_status. From: atd_stub, a navigation program of the vehicle. To: uuv_modem. Delivery: plain,
    priority 5.
    """
    return _of(vehicle, "status")


def acoustic_status(vessel: str) -> str:
    """The position and state of a vehicle, received over the acoustic link.

    Record: received_status. From: op_modem. To: relay, console, watchers. Delivery: plain, priority 5.
    """
    return _of(vessel, "acoustic/status")


def acoustic_status_everywhere() -> str:
    """The status of all vehicles, as all vessels receive it."""
    return f"{ROOT}/*/acoustic/status"


def acoustic_range(vessel: str) -> str:
    """The measured distance between vessel and vehicle.

    Record: vehicle_range. From: op_modem. To: console, watchers. Delivery: plain, priority 5.
    """
    return _of(vessel, "acoustic/range")


def acoustic_range_everywhere() -> str:
    """The measured distances of all vessels."""
    return f"{ROOT}/*/acoustic/range"


def acoustic_transmissions(vehicle: str) -> str:
    """The times at which the vehicle's modem transmitted; uuv_modem also replies to a query with the record.

    Record: transmissions. From: uuv_modem. To: atd_stub, watchers. Delivery: plain, priority 5.
    """
    return _of(vehicle, "acoustic/transmissions")


def acoustic_downlink(vessel: str) -> str:
    """The progress of a command or decision on its way to a vehicle.

    Record: downlink_state. From: op_modem. To: watchers. Delivery: plain, priority 5.
    """
    return _of(vessel, "acoustic/downlink")


def message_received(vessel: str) -> str:
    """A message that a vehicle sent over the acoustic link.

    Without configured consumers it is published only.

    Record: received_message. From: op_modem. To: the configured consumers. Delivery: durable, priority 4.
    """
    return _of(vessel, "message/received")


def message_outgoing(vehicle: str) -> str:
    """Other data for the acoustic link.

    Record: outgoing_message. From: any program of the vehicle. To: uuv_modem. Delivery: durable, priority 4.
    """
    return _of(vehicle, "message/outgoing")


def image_reconstructed(vessel: str) -> str:
    """A decoded image (the paper's imgToDecompress on the operator's side).

    Record: reconstructed_image. From: decompressor. To: console. Delivery: durable, priority 5.
    """
    return _of(vessel, "image/reconstructed")


def image_coded(vessel: str) -> str:
    """The coded content of an image that the vessel could decode.

    Record: coded_image. From: decompressor. To: relay. Delivery: durable, priority 5.
    """
    return _of(vessel, "image/coded")


def codebook(vessel: str, model: str) -> str:
    """A codebook of the vessel's decompressor, which replies to a query with one piece of the file.

    Record: none. From: c2. To: decompressor. Delivery: query.
    """
    return _of(vessel, f"codebook/{_name('model', model)}")


def codebook_all(vessel: str) -> str:
    """All codebooks of one vessel."""
    return _of(vessel, "codebook/*")


def contact_decision(vessel: str) -> str:
    """An operator's decision.

    Record: decision. From: console, another operator's program. To: relay, op_modem. Delivery: durable, priority 2.
    """
    return _of(vessel, "contact/decision")


def command(platform: str, kind: str) -> str:
    """A command for a vehicle.

    On the vehicle, the kind `decision` carries a record `decision`.

    Record: command. From: c2. To: relay. Delivery: durable, priority 1, not published.
    Record: command. From: relay, console. To: op_modem. Delivery: durable, priority 1.
    Record: command. From: uuv_modem. To: compressor, the configured consumers. Delivery: durable, priority 1.
    """
    return _of(platform, f"command/{_name('kind', kind)}")


def command_all(platform: str) -> str:
    """Commands of every kind."""
    return _of(platform, "command/*")


def comment(vessel: str) -> str:
    """An expert's comment from the shore site.

    Record: comment. From: c2. To: relay. Delivery: durable, priority 2, not published.
    Record: comment. From: relay. To: console, the configured consumers. Delivery: durable, priority 2.
    """
    return _of(vessel, "comment")


def shore_inbox(vessel: str, site: str = SHORE) -> str:
    """A vessel's record in its envelope.

    Priority 2 for decisions, 5 for the first version of an image, 6 for later ones.

    Record: relayed. From: relay. To: c2. Delivery: durable, priority 2, 5 or 6, not published.
    """
    return _of(site, f"inbox/{_name('vessel', vessel)}")


def shore_part(vessel: str, site: str = SHORE) -> str:
    """A vessel's coded image: the whole, or the difference to a version that the site has acknowledged.

    Priority 5 for the first version of an image, 6 for later ones.

    Record: part. From: relay. To: c2. Delivery: durable, priority 5 or 6, not published.
    """
    return _of(site, f"inbox/{_name('vessel', vessel)}/part")


def shore_part_all(site: str = SHORE) -> str:
    """Coded images of every vessel to one site."""
    return _of(site, "inbox/*/part")


@functools.lru_cache(1024)
def part_vessel(key: str) -> str:
    """Return the vessel that a key made by `shore_part` names.

    Raises:
        BadInputError: It is another key.
    """
    return _vessel_in(key, f"{ROOT}/{{site}}/inbox/{{vessel}}/part")


def shore_inbox_all(site: str = SHORE) -> str:
    """Envelopes of every vessel to one site."""
    return _of(site, "inbox/*")


def shore_image(vessel: str, site: str = SHORE) -> str:
    """A vessel's image that the site's c2 has stored.

    Record: reconstructed_image. From: c2. To: watchers. Delivery: plain, priority 5.
    """
    return _of(site, f"contact/{_name('vessel', vessel)}/image")


def shore_coded(vessel: str, site: str = SHORE) -> str:
    """A vessel's image in coded form that the site's c2 has accepted.

    Record: coded_image. From: c2. To: watchers. Delivery: plain, priority 5.
    """
    return _of(site, f"contact/{_name('vessel', vessel)}/coded")


def shore_decision(vessel: str, site: str = SHORE) -> str:
    """A vessel's decision that the site's c2 has stored.

    Record: decision. From: c2. To: watchers. Delivery: plain, priority 5.
    """
    return _of(site, f"contact/{_name('vessel', vessel)}/decision")


def shore_status(vessel: str, site: str = SHORE) -> str:
    """The latest status of a vehicle that the site's c2 has received from a vessel. It is not stored.

    Record: received_status. From: c2. To: console, watchers. Delivery: plain, priority 5.
    """
    return _of(site, f"status/{_name('vessel', vessel)}")


def shore_status_all(site: str = SHORE) -> str:
    """Statuses of the vehicles of every vessel at one site."""
    return _of(site, "status/*")


def shore_status_everywhere() -> str:
    """Statuses of the vehicles of every vessel at every site."""
    return f"{ROOT}/*/status/*"


def shore_contact_all(site: str = SHORE) -> str:
    """All records of every vessel that a site's c2 has stored."""
    return _of(site, "contact/*/*")


def shore_contact_everywhere() -> str:
    """All records of every vessel that the c2 of any site has stored, for routers."""
    return f"{ROOT}/*/contact/*/*"


def json_mirror(key: str) -> str:
    """Return the key of the JSON form of a record that c2 publishes: `json` after the site.

    Raises:
        BadInputError: It is not a key below a platform.
    """
    parts = key.split("/")
    if len(parts) < 4 or not key.startswith(f"{ROOT}/"):
        raise BadInputError(key, "", key, f"{ROOT}/{{site}}/…")
    return "/".join([*parts[:3], "json", *parts[3:]])


def tasking_comment(vessel: str, site: str = SHORE) -> str:
    """An expert's comment for one vessel.

    Record: comment. From: console, `sonarpost c2 comment`. To: c2. Delivery: durable, priority 2.
    """
    return _of(site, f"tasking/{_name('vessel', vessel)}/comment")


def tasking_comment_all(site: str = SHORE) -> str:
    """Comments for every vessel."""
    return _of(site, "tasking/*/comment")


def tasking_command(vessel: str, site: str = SHORE) -> str:
    """A command for a vehicle of one vessel.

    Record: command. From: console, `sonarpost c2 command`. To: c2. Delivery: durable, priority 1.
    """
    return _of(site, f"tasking/{_name('vessel', vessel)}/command")


def tasking_command_all(site: str = SHORE) -> str:
    """Commands for the vehicles of every vessel."""
    return _of(site, "tasking/*/command")


def tasking_vessel(key: str) -> str:
    """Return the vessel that a key made by `tasking_comment` or `tasking_command` names.

    Raises:
        BadInputError: It is another key.
    """
    return _vessel_in(key, f"{ROOT}/{{site}}/tasking/{{vessel}}/…")


def tasking_state(vessel: str, site: str = SHORE) -> str:
    """The progress of a comment or command to one vessel.

    Record: tasking_state. From: c2. To: watchers. Delivery: plain, priority 5.
    """
    return _of(site, f"tasking/{_name('vessel', vessel)}/state")


def tasking_state_all(site: str = SHORE) -> str:
    """Progress of comments and commands to every vessel."""
    return _of(site, "tasking/*/state")


def tasking_state_everywhere() -> str:
    """Progress of comments and commands at every site, for routers."""
    return f"{ROOT}/*/tasking/*/state"


def health(platform: str, service: str) -> str:
    """A service's health.

    Record: health. From: every service. To: watchers. Delivery: plain, priority 5.
    """
    return _of(platform, f"health/{_name('service', service)}")


def health_all(platform: str) -> str:
    """Health of every service of one platform."""
    return _of(platform, "health/*")


def health_everywhere() -> str:
    """Health of every service of every platform."""
    return f"{ROOT}/*/health/*"


def alive(platform: str, service: str) -> str:
    """A service's liveliness token.

    Record: none. From: every service. To: watchers. Delivery: liveliness token.
    """
    return _of(platform, f"alive/{_name('service', service)}")


def alive_all(platform: str) -> str:
    """Liveliness tokens of every service of one platform."""
    return _of(platform, "alive/*")


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
    """Delivery queries for records of `key` to the named consumer."""
    return f"{key}/delivery/{_name('consumer', consumer)}"


def delivery_query_any(key: str) -> str:
    """Delivery queries for records of `key` to every consumer."""
    return f"{key}/delivery/*"


def writer_of(key: str) -> str:
    """Return the part of a key that access control grants to one group of peers.

    It is `{site}/inbox/{vessel}` for the inbox of a vessel, otherwise the platform and the first word behind it: a
    console may write below `{site}/tasking` under any name.
    """
    parts = key.split("/")
    return "/".join(parts[: 5 if parts[3:4] == ["inbox"] else 4])


def presence(vessel: str, service: str, site: str = SHORE) -> str:
    """Presence query of a vessel to a service of the shore site, and its reply.

    Record: none. From: relay. To: c2, the router of the shore site. Delivery: query.
    """
    return f"{shore_inbox(vessel, site)}/hello/{_name('service', service)}"


def presence_any(vessel: str, site: str = SHORE) -> str:
    """Presence queries of one vessel to every process of a site."""
    return f"{shore_inbox(vessel, site)}/hello/*"


def presence_all_vessels(service: str, site: str = SHORE) -> str:
    """Presence queries of every vessel to one process of a site."""
    return f"{shore_inbox_all(site)}/hello/{_name('service', service)}"


def below(key: str) -> str:
    """A key and all keys below it, for access control."""
    return f"{key}/**"


def everything_of(platform: str) -> str:
    """All keys of one platform, for access control."""
    return _of(platform, "**")


def everything() -> str:
    """All keys of sonarpost, for access control."""
    return f"{ROOT}/**"


# Keys of a router's administration, for Zenoh's tools and REST interface; `**` does not match them.
ROUTER_ADMINISTRATION = "@/**"
ANY = "**"
