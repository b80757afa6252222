"""What a router's Zenoh core says in its log about refused peers, read line by line.

Zenoh tells neither side of a refusal in its interface: a TLS hand-shake that fails and a message that access control
stops leave a line in the router's log and nothing else. The lines and their levels are those of Zenoh 1.10; a test with
real routers holds them to it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

# Which lines are wanted of Zenoh. Decisions of access control are said at TRACE only.
FILTER = ",".join(
    (
        "error",
        "zenoh::net::runtime::orchestrator=warn",
        "zenoh::net::routing::interceptor=trace",
        "zenoh::net::routing::interceptor::authorization=error",
        "zenoh_link_tls=warn",
        "zenoh_link_tcp=warn",
        "zenoh_transport=warn",
    )
)

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_LINE = re.compile(
    r"\S+Z\s+(?P<level>TRACE|DEBUG|INFO|WARN|ERROR)\s+(?:\S+\s+)?ThreadId\((?P<thread>\d+)\)\s+"
    r"(?:.*?\s)??(?P<module>zenoh\w*(?:::\w+)*):\s(?P<text>.*)",
    re.DOTALL,
)
_DECISION = re.compile(
    r"(?:Using cached result: )?(?P<zid>[0-9a-f]{1,32}) (?:on (?P<subject>\S+) )?is (?P<no>un)?authorized to "
    r"(?P<message>.+?) \((?P<flow>ingress|egress)\) on (?P<key>.*)",
    re.DOTALL,
)
_NAME = re.compile(r"CertCommonName\((?P<name>[^()]*)\)")
_STRANGER = re.compile(r"(?P<zid>[0-9a-f]{1,32}) did not match any configured ACL subject")
_HINT = re.compile(r"\.? ?Hint: increase the system open file limit\.?$")
_ALLOWED = " is authorized to "
_INTERCEPTED = "Msg intercepted!"
_MAX_KEPT = 256


@dataclass(frozen=True, slots=True)
class TlsRejected:
    """A peer's TLS hand-shake failed.

    Attributes:
        reason: In Zenoh's words; the peer's address is not in them.
    """

    reason: str


@dataclass(frozen=True, slots=True)
class Denied:
    """Access control stopped a message.

    Attributes:
        zid: Zenoh identity of the peer, empty when the log does not say.
        name: Common name of its certificate, empty when it has none or the log does not say.
        message: Kind of message, "Put" for example.
        flow: "ingress": the peer sent it. "egress": it was to get it.
        key: Key expression, empty when the log does not say.
    """

    zid: str
    name: str
    message: str
    flow: Literal["ingress", "egress", ""]
    key: str


@dataclass(frozen=True, slots=True)
class UnknownCertificateAuthority:
    """A peer was let in by TLS whose certificate is on no list: whatever it says is denied."""

    zid: str


@dataclass(frozen=True, slots=True)
class ZenohLogMessage:
    """Anything else that Zenoh finds worth a warning or an error."""

    level: str
    module: str
    text: str


Event = TlsRejected | Denied | UnknownCertificateAuthority | ZenohLogMessage


class ZenohLog:
    """Reads the log of one process, whose threads write in between each other."""

    def __init__(self) -> None:
        # The refusal that a thread's last decision was, if it was one.
        self._last: dict[str, re.Match[str]] = {}
        self._names: dict[str, str] = {}

    def feed(self, line: str) -> Event | None:
        """Return what a line says, None when it is of no interest.

        Raises:
            ValueError: Not a line of Zenoh's log.
        """
        if not self._last and _ALLOWED in line:
            # Nearly every line of a router at work; nothing of it is wanted while no refusal is under way.
            return None
        match = _LINE.fullmatch(_COLOUR.sub("", line.rstrip("\r\n")))
        if match is None:
            raise ValueError("not a line of Zenoh's log")
        level, thread, module, text = match["level"], match["thread"], match["module"], match["text"]
        if module.startswith("zenoh::net::routing::interceptor"):
            return self._interceptor(thread, text, level, module)
        if level not in ("WARN", "ERROR"):
            return None
        if module.startswith("zenoh_link_tls"):
            return TlsRejected(_HINT.sub("", text))
        return ZenohLogMessage(level, module, text)

    def _interceptor(self, thread: str, text: str, level: str, module: str) -> Event | None:
        if text == _INTERCEPTED:
            return self._denied(self._last.pop(thread, None))
        if (stranger := _STRANGER.match(text)) is not None:
            return UnknownCertificateAuthority(stranger["zid"])
        if (decision := _DECISION.fullmatch(text)) is not None:
            self._note(thread, decision)
            return None
        return ZenohLogMessage(level, module, text) if level in ("WARN", "ERROR") else None

    def _note(self, thread: str, decision: re.Match[str]) -> None:
        """A decision may be asked for ahead of time; only the one right before the message is stopped counts."""
        if decision["no"]:
            self._learn_name(decision)
            if len(self._last) >= _MAX_KEPT:
                self._last.clear()
            self._last[thread] = decision
        else:
            self._last.pop(thread, None)

    def _learn_name(self, decision: re.Match[str]) -> None:
        """Remember whose decision it is: a line about a cached one names the Zenoh identity alone."""
        name = _NAME.search(decision["subject"] or "")
        if name is not None:
            if len(self._names) >= _MAX_KEPT:
                self._names.clear()
            self._names[decision["zid"]] = name["name"]

    def _denied(self, decision: re.Match[str] | None) -> Denied:
        if decision is None:
            return Denied("", "", "", "", "")
        flow: Literal["ingress", "egress"] = "ingress" if decision["flow"] == "ingress" else "egress"
        name = self._names.get(decision["zid"], "")
        return Denied(decision["zid"], name, decision["message"], flow, decision["key"])
