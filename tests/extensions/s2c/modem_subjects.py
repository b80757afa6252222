"""The S2C driver and its emulated modem, for the suites of all modem drivers."""

from builders.host_sessions import HostInput, hears
from builders.hostile_line import DATA_REQUESTS, DUMPS, PADDED, Subject

S2C_NOT_APPLICABLE = {
    "the modem does not send its settings without a request": DUMPS,
    "the command contains the data: the modem does not request it": (*DATA_REQUESTS, "restart after the data"),
    "messages have a length and no checksum": ("no checksums",),
    "messages have the length of their data": PADDED,
    "errors are answers to commands": ("errors and messages every second",),
}


def message_kind(message: bytes) -> str:
    """Return the command that a message of an S2C modem answers, or the name of a notification."""
    command, _, text = message.removeprefix(b"+++AT").partition(b":")
    return (command or text.partition(b":")[2].partition(b",")[0].strip()).decode("ascii", "replace")


def messages(data: bytes) -> list[bytes]:
    """Divide the bytes of an emulated S2C modem, which does not send `+++AT` as data in these tests."""
    return [b"+++AT" + part for part in data.split(b"+++AT")[1:]]


def s2c(command: str, rate: int | None = None) -> Subject:
    return Subject(
        "s2c",
        message_kind,
        messages,
        restart=b"+++ATZ0\n",
        refusal=(command, b"+++AT%b:23:BUSY DELIVERING MESSAGE\r\n" % command.encode()),
        reception=(b"+++AT:9:RECVSTART\r\n", b"+++AT:23:RECVFAILED,0.0000,-40,0\r\n"),
        unknown=b"+++AT:11:RECVXYZ,1,2\r\n",
        not_applicable=S2C_NOT_APPLICABLE,
        rate=rate,
    )


SUBJECTS = [s2c("*SENDIM"), s2c("*SEND", rate=1)]
INPUT = {
    "s2c": HostInput(
        commands=[
            *(b"+++ATC\n", b"ATO\n", b"+++ATZ0\n", b"ATZ4\n", b"+++AT*SEND,1000,2,a", b"AT*SENDIM,64,2,ack,", b"AT"),
            *(b"AT*SEND,1,9,a\n", b"+++AT*SENDIM,1,2,ack,a\r\n", b"+++AT@ZX1\n", b"AT!AL7\n", b"+++AT!AR1\n", b"+++"),
        ],
        incomplete=b"+++AT*SEND,1000,2,a",
        question=b"+++AT?S\n",
        is_answered=hears(rb"INITIATION LISTEN\r\n\Z"),
    )
}
