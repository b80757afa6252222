"""Key expressions, and rejection of names that would change a key."""

import inspect
import string

import pytest
import zenoh
from hypothesis import example, given
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
    "sonarpost/v1/vessel-1/comment": keys.comment("vessel-1"),
    "sonarpost/v1/shore-2/inbox/vessel-1": keys.shore_inbox("vessel-1", "shore-2"),
    "sonarpost/v1/shore-2/inbox/*": keys.shore_inbox_all("shore-2"),
    "sonarpost/v1/shore-2/contact/vessel-1/image": keys.shore_image("vessel-1", "shore-2"),
    "sonarpost/v1/shore-2/contact/vessel-1/decision": keys.shore_decision("vessel-1", "shore-2"),
    "sonarpost/v1/shore/contact/*/*": keys.shore_contact_all(),
    "sonarpost/v1/*/acoustic/queue": keys.acoustic_queue_everywhere(),
    "sonarpost/v1/shore/tasking/vessel-1/comment": keys.tasking_comment("vessel-1"),
    "sonarpost/v1/shore/tasking/*/comment": keys.tasking_comment_all(),
    "sonarpost/v1/shore/tasking/vessel-1/command": keys.tasking_command("vessel-1"),
    "sonarpost/v1/shore/tasking/*/command": keys.tasking_command_all(),
    "sonarpost/v1/shore/tasking/vessel-1/state": keys.tasking_state("vessel-1"),
    "sonarpost/v1/shore/tasking/*/state": keys.tasking_state_all(),
    "sonarpost/v1/uuv-1/health/atd_stub": keys.health("uuv-1", "atd_stub"),
    "sonarpost/v1/uuv-1/health/*": keys.health_all("uuv-1"),
    "sonarpost/v1/uuv-1/alive/atd_stub": keys.alive("uuv-1", "atd_stub"),
    "sonarpost/v1/shore/inbox/*/delivery/c2": keys.delivery_query(keys.shore_inbox_all(), "c2"),
}

# The name of each parameter of each function in the module that makes a key, with valid names for the others.
PARAMETERS = [
    (make, name)
    for make in vars(keys).values()
    if inspect.isfunction(make) and make.__module__ == keys.__name__ and not make.__name__.startswith("_")
    for name in inspect.signature(make).parameters
    if name != "key"
]


def test_keys_match_the_specification():
    for expected, key in EXPECTED.items():
        assert key == expected == str(zenoh.KeyExpr(expected))


def test_keys_of_a_platform_have_one_prefix():
    own = zenoh.KeyExpr("sonarpost/v1/uuv-1/**")
    assert [key for key in EXPECTED if own.includes(key)] == [key for key in EXPECTED if "/uuv-1/" in key]


def test_keys_of_different_records_do_not_overlap():
    written = [key for key in EXPECTED if "*" not in key]
    for key in written:
        assert [other for other in written if zenoh.KeyExpr(key).intersects(other)] == [key]
    assert zenoh.KeyExpr(keys.shore_inbox_all()).includes(keys.shore_inbox("vessel-1"))
    assert not zenoh.KeyExpr(keys.shore_inbox_all()).intersects(keys.delivery_query(keys.shore_inbox("vessel-1"), "c2"))


def test_every_key_function_rejects_a_name_that_would_change_the_key():
    assert len(PARAMETERS) > 60
    for make, name in PARAMETERS:
        valid = {other: "a/b" if other == "key" else "uuv-1" for other in inspect.signature(make).parameters}
        make(**valid)
        with pytest.raises(BadInputError, match="expected 1 to 40 of a-z, 0-9"):
            make(**valid | {name: "a/b"})


@example("a/b")
@example("a\n")
@example("a" * 41)
@given(st.text(max_size=45))
def test_arbitrary_text_is_a_name_or_rejected(name):
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
