"""A vessel delivers acoustic frames to its own inbox at the lead vessel, and has no other right there."""

import time
from pathlib import PurePosixPath

import pytest
import zenoh
from builders.common import eventually, free_port

from sonarpost import keys
from sonarpost.bus.session import client_config
from sonarpost.delivery.inbox import Inbox
from sonarpost.delivery.outbox import Outbox
from sonarpost.delivery.store import Store
from sonarpost.errors import BadInputError
from sonarpost.security.router_config import RouterOptions, router_json5

pytestmark = pytest.mark.system

LEAD, OTHER = "vessel-1", "vessel-2"
INBOX = keys.vessel_frames(LEAD, OTHER)
DENIED = (
    keys.vessel_frames(LEAD, "vessel-3"),
    keys.acoustic_image(LEAD),
    keys.message_received(LEAD),
    keys.command(LEAD, "resend"),
    keys.contact_decision(LEAD),
    keys.comment(LEAD),
)


@pytest.fixture(scope="module")
def lead(shared_world):
    """A second router with the certificate of the lead vessel, which admits the other vessel; its two endpoints."""
    tls, local = f"tls/localhost:{free_port()}", f"tcp/127.0.0.1:{free_port()}"
    files = PurePosixPath(shared_world.folders[LEAD])
    options = RouterOptions(LEAD, listen=[tls], local=[local], files=files, other_vessels=[OTHER])
    router = shared_world.start("lead", options)
    yield router, tls, local
    router.stop()


def test_frames_pass_the_routers_of_both_vessels(world, lead, tmp_path):
    _router, tls, lead_local = lead
    local = f"tcp/127.0.0.1:{free_port()}"
    options = RouterOptions(
        OTHER, local=[local], connect=[tls], files=PurePosixPath(world.folders[OTHER]), lead_vessel=LEAD
    )
    other = world.start("other", options)
    store, sent = Store(tmp_path / "lead.db"), Store(tmp_path / "other.db")
    with zenoh.open(client_config([lead_local])) as at_lead, zenoh.open(client_config([local])) as at_other:
        inbox = Inbox(at_lead, store, "op_modem", (INBOX,), lambda _key, _payload: None, lambda _error: None)
        with sent.transaction() as tx:
            for number in range(20):
                tx.send(INBOX, "op_modem", b"frame %d" % number, encoding="")
        outbox = Outbox(at_other, sent)
        eventually(lambda: sent.outbox_depth() == 0, what="the frames at the lead vessel")
        assert [item.payload for item in store.inbox_items(100)] == [b"frame %d" % n for n in range(20)]
        outbox.close()
        inbox.close()
    for closing in (store, sent):
        closing.close()
    other.stop()


def test_other_vessel_has_no_other_right(world, lead):
    router, tls, lead_local = lead
    asked: list[str] = []

    def answer(query):
        with query:
            asked.append(str(query.key_expr))
            query.reply(query.key_expr, b"stored")

    def answered(session, key):
        selector = keys.delivery_query(key, "op_modem")
        return [r.ok.payload.to_bytes() for r in session.get(selector, timeout=30) if r.ok] == [b"stored"]

    with zenoh.open(client_config([lead_local])) as at_lead, world.open(OTHER, endpoint=tls) as hostile:
        for key in (INBOX, *DENIED):
            at_lead.declare_queryable(keys.delivery_query(key, "op_modem"), answer)
        at_lead.declare_subscriber(keys.everything(), lambda sample: asked.append(f"put {sample.key_expr}"))
        read: list[str] = []
        hostile.declare_subscriber(keys.everything(), lambda sample: read.append(str(sample.key_expr)))
        eventually(lambda: answered(hostile, INBOX), what="the inbox")
        assert not any(answered(hostile, key) for key in DENIED)
        for key in (INBOX, *DENIED):
            hostile.put(key, b"false")
        at_lead.put(keys.acoustic_rx(LEAD), b"secret")
        router.wait_for_denial(OTHER, "Put", keys.acoustic_image(LEAD))
    assert set(asked) == {keys.delivery_query(INBOX, "op_modem"), f"put {keys.acoustic_rx(LEAD)}"}
    assert keys.acoustic_rx(LEAD) not in read


def test_invalid_names_are_refused(world):
    for platform, options in (
        ("shore-1", {"other_vessels": [OTHER]}),
        (LEAD, {"other_vessels": ["vessel-9"]}),
        (LEAD, {"other_vessels": [LEAD]}),
        (LEAD, {"other_vessels": [OTHER], "lead_vessel": OTHER}),
        (LEAD, {"lead_vessel": "shore-1"}),
    ):
        with pytest.raises(BadInputError, match="router-config: vessel"):
            router_json5(world.fleet.index(), RouterOptions(platform, **options), time.time())
