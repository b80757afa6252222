"""Lines of the router's log, as Zenoh 1.10 writes them."""

from __future__ import annotations

import msgpack
import pytest
import zenoh

from sonarpost.bus import presence as hello
from sonarpost.bus.presence import PresenceReply
from sonarpost.bus.router_monitor import MAX_TOLD, RefusedPeers, platform_and_sites
from sonarpost.bus.zenoh_log import Denied, TlsRejected, UnknownCertificateAuthority, ZenohLog, ZenohLogMessage
from sonarpost.errors import BadInputError, PayloadError

ACL = "zenoh::net::routing::interceptor::access_control"
ZID = "7aa9d969cdd8c646d5214fff498d40ab"


def line(level: str, module: str, text: str, thread: str = "rx-0 ThreadId(10)") -> str:
    return f"2026-11-21T11:51:25.632188Z {level:>5} {thread} {module}: {text}\n"


def decision(verdict: str, message: str, key: str, *, cached: bool = False) -> str:
    who = "" if cached else f"on Interface(lo)+CertCommonName(vessel-1)+Transport(Tls)+{ZID} "
    return line(
        "TRACE", ACL, f"{'Using cached result: ' if cached else ''}{ZID} {who}is {verdict} to {message} on {key}"
    )


INTERCEPTED = line("TRACE", "zenoh::net::routing::interceptor", "Msg intercepted!")


def events(*lines: str) -> list[object]:
    reader = ZenohLog()
    return [event for event in map(reader.feed, lines) if event is not None]


@pytest.mark.parametrize("colour", [False, True])
def test_a_refused_handshake_is_told_without_the_hint_about_something_else(colour):
    text = line(
        " WARN",
        "zenoh_link_tls::unicast",
        "peer sent no certificates. Hint: increase the system open file limit.",
        "acc-0 ThreadId(06)",
    )
    if colour:
        text = text.replace("zenoh_link_tls::unicast", "\x1b[2mzenoh_link_tls::unicast\x1b[0m")
    assert events(text) == [TlsRejected("peer sent no certificates")]


def test_a_denial_is_a_decision_right_before_the_message_is_stopped():
    assert events(decision("unauthorized", "Put (ingress)", "a/b c"), INTERCEPTED) == [
        Denied(ZID, "vessel-1", "Put", "ingress", "a/b c")
    ]


def test_decisions_asked_for_ahead_of_time_are_no_denials():
    ahead = [decision("unauthorized", f"{message} (ingress)", "a") for message in ("Query", "Reply", "Delete")]
    assert events(*ahead, decision("authorized", "Put (ingress)", "a")) == []
    assert events(*ahead, decision("authorized", "Put (ingress)", "a"), INTERCEPTED) == [Denied("", "", "", "", "")]


def test_a_cached_decision_has_the_name_that_was_read_before():
    read = events(
        decision("unauthorized", "Declare/Undeclare Liveliness Token (ingress)", "a"),
        decision("unauthorized", "Liveliness Token (ingress)", "a", cached=True),
        INTERCEPTED,
    )
    assert read == [Denied(ZID, "vessel-1", "Liveliness Token", "ingress", "a")]


def test_threads_write_in_between_each_other():
    stopped_elsewhere = INTERCEPTED.replace("rx-0 ThreadId(10)", "rx-1 ThreadId(11)")
    read = events(decision("unauthorized", "Put (egress)", "a"), stopped_elsewhere, INTERCEPTED)
    assert read == [Denied("", "", "", "", ""), Denied(ZID, "vessel-1", "Put", "egress", "a")]


def test_a_peer_on_no_list_is_told():
    text = f"{ZID} did not match any configured ACL subject. Default permission `Deny` will be applied on all messages"
    assert events(line(" INFO", f"rt{{zid=fb8ed621}}: {ACL}", text)) == [UnknownCertificateAuthority(ZID)]


def test_warnings_of_other_parts_are_kept_and_the_rest_is_not():
    assert events(
        line("ERROR", "demux{zid=1 src=south:0}:undeclare{id=2 expr=}: zenoh::net::routing::hat", "Unknown token id=2"),
        line(" INFO", "zenoh::net::runtime", "Using ZID: 1"),
    ) == [ZenohLogMessage("ERROR", "zenoh::net::routing::hat", "Unknown token id=2")]


@pytest.mark.parametrize("text", ["", "Traceback (most recent call last):\n", "2026 WARN something\n", "\x00\xff\n"])
def test_what_is_no_line_of_the_log_is_said_to_be_none(text):
    with pytest.raises(ValueError, match="not a line"):
        ZenohLog().feed(text)


def test_each_kind_of_refusal_is_told_once_an_interval_and_then_counted():
    refusals = RefusedPeers()
    told = [refusals.count("messages_denied", "vessel-1", "Put", "a") for _ in range(5)]
    assert told == [True, False, False, False, False]
    assert refusals.counters["messages_denied"] == 5
    assert refusals.repeated() == [(("messages_denied", "vessel-1", "Put", "a"), 4)]
    assert refusals.count("messages_denied", "vessel-1", "Put", "a")


def test_a_flood_of_different_refusals_is_counted_and_not_told():
    refusals = RefusedPeers()
    told = sum(refusals.count("messages_denied", "vessel-1", "Put", f"key/{n}") for n in range(10_000))
    assert told == MAX_TOLD
    assert refusals.counters["messages_denied"] == 10_000
    assert refusals.repeated() == [(("messages_denied", "others"), 10_000 - MAX_TOLD)]


@pytest.mark.parametrize(
    ("metadata", "described"),
    [
        ("null", (None, ())),
        ("'a name'", (None, ())),
        ("{name: 'a'}", (None, ())),
        ("{platform: 'vessel-1'}", ("vessel-1", ())),
        ("{platform: 'shore-1', sites: ['shore', 'north']}", ("shore-1", ("shore", "north"))),
    ],
)
def test_a_configuration_says_whose_router_it_is_for(metadata, described):
    assert platform_and_sites(zenoh.Config.from_json5(f"{{metadata: {metadata}}}")) == described


@pytest.mark.parametrize("metadata", ["{platform: 7}", "{platform: 'No Name'}", "{platform: 'a', sites: 'shore'}"])
def test_a_configuration_that_says_it_wrongly_is_refused(metadata):
    with pytest.raises(BadInputError):
        platform_and_sites(zenoh.Config.from_json5(f"{{metadata: {metadata}}}"))


def test_a_hello_is_read_as_it_was_written():
    assert hello.parse(PresenceReply("shore-1", "c2").pack(), "key") == PresenceReply("shore-1", "c2")


@pytest.mark.parametrize(
    "fields",
    [
        {},
        {"v": 2, "platform": "a", "service": "b"},
        {"v": 1, "platform": 3, "service": "b"},
        {"v": 1, "platform": "a", "service": "b" * 41},
        {"v": 1, "platform": "", "service": "b"},
    ],
)
def test_a_hello_that_is_none_is_refused(fields):
    with pytest.raises(PayloadError):
        hello.parse(msgpack.packb(fields), "key")
    with pytest.raises(PayloadError):
        hello.parse(b"junk", "key")
