"""Key expressions, and rejection of names that would change a key."""

from __future__ import annotations

import string
from collections.abc import Callable

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from sonarpost import keys
from sonarpost.errors import BadInputError

EXPECTED = {
    "sonarpost/v1/uuv-1/contact/detected": keys.contact_detected("uuv-1"),
    "sonarpost/v1/uuv-1/image/encoded": keys.image_encoded("uuv-1"),
    "sonarpost/v1/uuv-1/acoustic/tx": keys.acoustic_tx("uuv-1"),
    "sonarpost/v1/uuv-1/acoustic/queue": keys.acoustic_queue("uuv-1"),
    "sonarpost/v1/uuv-1/acoustic/transmissions": keys.acoustic_transmissions("uuv-1"),
    "sonarpost/v1/uuv-1/status": keys.vehicle_status("uuv-1"),
    "sonarpost/v1/vessel-1/acoustic/status": keys.acoustic_status("vessel-1"),
    "sonarpost/v1/shore/status/vessel-1": keys.shore_status("vessel-1"),
    "sonarpost/v1/shore/status/*": keys.shore_status_all(),
    "sonarpost/v1/*/status/*": keys.shore_status_everywhere(),
    "sonarpost/v1/vessel-1/acoustic/range": keys.acoustic_range("vessel-1"),
    "sonarpost/v1/*/acoustic/range": keys.acoustic_range_everywhere(),
    "sonarpost/v1/*/acoustic/status": keys.acoustic_status_everywhere(),
    "sonarpost/v1/vessel-1/acoustic/downlink": keys.acoustic_downlink("vessel-1"),
    "sonarpost/v1/vessel-1/message/received": keys.message_received("vessel-1"),
    "sonarpost/v1/uuv-1/message/outgoing": keys.message_outgoing("uuv-1"),
    "sonarpost/v1/vessel-1/acoustic/rx": keys.acoustic_rx("vessel-1"),
    "sonarpost/v1/vessel-1/inbox/vessel-2/frame": keys.vessel_frames("vessel-1", "vessel-2"),
    "sonarpost/v1/vessel-1/acoustic/image": keys.acoustic_image("vessel-1"),
    "sonarpost/v1/vessel-1/image/reconstructed": keys.image_reconstructed("vessel-1"),
    "sonarpost/v1/vessel-1/contact/decision": keys.contact_decision("vessel-1"),
    "sonarpost/v1/vessel-1/command/refine": keys.command("vessel-1", "refine"),
    "sonarpost/v1/shore/inbox/vessel-1": keys.shore_inbox("vessel-1"),
    "sonarpost/v1/shore/inbox/*": keys.shore_inbox_all(),
    "sonarpost/v1/shore/contact/vessel-1/image": keys.shore_image("vessel-1"),
    "sonarpost/v1/shore/contact/vessel-1/decision": keys.shore_decision("vessel-1"),
    "sonarpost/v1/vessel-1/command/*": keys.command_all("vessel-1"),
    "sonarpost/v1/vessel-1/advice": keys.advice("vessel-1"),
    "sonarpost/v1/shore-2/inbox/vessel-1": keys.shore_inbox("vessel-1", "shore-2"),
    "sonarpost/v1/shore-2/inbox/*": keys.shore_inbox_all("shore-2"),
    "sonarpost/v1/shore-2/contact/vessel-1/image": keys.shore_image("vessel-1", "shore-2"),
    "sonarpost/v1/shore-2/contact/vessel-1/decision": keys.shore_decision("vessel-1", "shore-2"),
    "sonarpost/v1/shore/contact/*/*": keys.shore_contact_all(),
    "sonarpost/v1/shore/contact/*/image": keys.shore_image_all(),
    "sonarpost/v1/shore/contact/*/decision": keys.shore_decision_all(),
    "sonarpost/v1/*/acoustic/queue": keys.acoustic_queue_everywhere(),
    "sonarpost/v1/shore/tasking/vessel-1/advice": keys.tasking_advice("vessel-1"),
    "sonarpost/v1/shore/tasking/*/advice": keys.tasking_advice_all(),
    "sonarpost/v1/shore/tasking/vessel-1/command": keys.tasking_command("vessel-1"),
    "sonarpost/v1/shore/tasking/*/command": keys.tasking_command_all(),
    "sonarpost/v1/shore/tasking/vessel-1/state": keys.tasking_state("vessel-1"),
    "sonarpost/v1/shore/tasking/*/state": keys.tasking_state_all(),
    "sonarpost/v1/uuv-1/health/atd_stub": keys.health("uuv-1", "atd_stub"),
    "sonarpost/v1/uuv-1/health/*": keys.health_all("uuv-1"),
    "sonarpost/v1/uuv-1/alive/atd_stub": keys.alive("uuv-1", "atd_stub"),
    "sonarpost/v1/shore/inbox/*/handoff/c2": keys.delivery_query(keys.shore_inbox_all(), "c2"),
}

OF_ONE_NAME: list[Callable[[str], str]] = [
    keys.contact_detected,
    keys.image_encoded,
    keys.acoustic_tx,
    keys.acoustic_rx,
    keys.acoustic_image,
    lambda name: keys.vessel_frames(name, "vessel-2"),
    lambda name: keys.vessel_frames("vessel-1", name),
    keys.acoustic_queue,
    keys.acoustic_transmissions,
    keys.vehicle_status,
    keys.acoustic_status,
    keys.acoustic_downlink,
    keys.message_received,
    keys.message_outgoing,
    keys.image_reconstructed,
    keys.contact_decision,
    keys.shore_inbox,
    keys.shore_image,
    keys.shore_decision,
    keys.health_all,
    keys.command_all,
    keys.advice,
    keys.shore_inbox_all,
    keys.shore_contact_all,
    keys.shore_image_all,
    keys.shore_decision_all,
    keys.tasking_advice,
    keys.tasking_advice_all,
    keys.tasking_command,
    keys.tasking_command_all,
    keys.tasking_state,
    keys.tasking_state_all,
    lambda name: keys.shore_inbox("vessel-1", name),
    lambda name: keys.shore_image("vessel-1", name),
    lambda name: keys.shore_decision("vessel-1", name),
    lambda name: keys.tasking_advice("vessel-1", name),
    lambda name: keys.tasking_command("vessel-1", name),
    lambda name: keys.tasking_state("vessel-1", name),
    lambda name: keys.command(name, "refine"),
    lambda name: keys.command("vessel-1", name),
    lambda name: keys.health(name, "relay"),
    lambda name: keys.health("vessel-1", name),
    lambda name: keys.alive(name, "relay"),
    lambda name: keys.alive("vessel-1", name),
    lambda name: keys.delivery_query("a/b", name),
]


@pytest.mark.parametrize("expected", EXPECTED)
def test_keys_match_the_specification(expected: str) -> None:
    assert EXPECTED[expected] == expected
    assert str(zenoh.KeyExpr(expected)) == expected


def test_keys_of_a_platform_have_one_prefix() -> None:
    own = zenoh.KeyExpr("sonarpost/v1/uuv-1/**")
    assert [key for key in EXPECTED if own.includes(key)] == [key for key in EXPECTED if "/uuv-1/" in key]


def test_keys_of_different_records_do_not_overlap() -> None:
    written = [key for key in EXPECTED if "*" not in key]
    for key in written:
        assert [other for other in written if zenoh.KeyExpr(key).intersects(other)] == [key]
    assert zenoh.KeyExpr(keys.shore_inbox_all()).includes(keys.shore_inbox("vessel-1"))
    assert not zenoh.KeyExpr(keys.shore_inbox_all()).intersects(keys.delivery_query(keys.shore_inbox("vessel-1"), "c2"))


@pytest.mark.parametrize("make", OF_ONE_NAME)
@pytest.mark.parametrize(
    "name",
    ["", "a/b", "*", "**", "$*", "a$*", "UUV", "-a", "_a", "a b", "a\n", "a#", "a?b", "ü", "a" * 41, "@a", "1\x00"],
)
def test_name_that_would_change_the_key_is_rejected(make: Callable[[str], str], name: str) -> None:
    with pytest.raises(BadInputError, match="expected 1 to 40 of a-z, 0-9"):
        make(name)


@given(st.text(max_size=45))
def test_arbitrary_text_is_a_name_or_rejected(name: str) -> None:
    allowed = set(string.ascii_lowercase + string.digits + "-_")
    good = 1 <= len(name) <= 40 and set(name) <= allowed and name[0] not in "-_"
    try:
        key = keys.health("uuv-1", name)
    except BadInputError:
        assert not good
    else:
        assert good
        assert key == f"sonarpost/v1/uuv-1/health/{name}"
        assert str(zenoh.KeyExpr(key)) == key
