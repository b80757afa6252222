"""The nanomodem driver and its emulated modem, for the suites of all modem drivers."""

from builders.host_sessions import HostInput, hears
from builders.hostile_line import DATA_REQUESTS, DUMPS, FALSE_RECEPTIONS, PADDED, REPORTS, RESTARTS, Subject

NANO_NOT_APPLICABLE = {
    "the modem has no such message": (*DUMPS, *DATA_REQUESTS, *PADDED),
    "the modem reports no start, end or statistics of a packet": REPORTS,
    "the modem has no report of a restart: a restart is a missing confirmation": RESTARTS,
    "the driver senses no carrier": FALSE_RECEPTIONS,
}
SUBJECTS = [
    Subject(
        "nano",
        lambda message: message[:2].decode("latin-1"),
        lambda data: [data],
        refusal=("$B", b"E\r\n"),
        unknown=b"#Zxyz\r\n",
        not_applicable=NANO_NOT_APPLICABLE,
    ),
]
INPUT = {
    "nano": HostInput(
        commands=[b"$N", b"$XTG", b"$R", b"$A0", b"$A005", b"$P002", b"$B64", b"$M00205hello", b"$U0026", b"$"],
        incomplete=b"$B64a",
        question=b"$?",
        is_answered=hears(rb"#A\d{3}V\d{5}\r\n\Z"),
    )
}
