"""A session of the public driver with the emulated nanomodem.

The session was read from the source of the driver; the test replays it without the program.
docs/reference/modem-nano.md names what was run.
"""

import re

from builders.host_sessions import Hosts, Step, replay

DATA = bytes(range(64))
STATUS = (b"$?", rb"#A001V\d{5}\r\n")
# nm3driver.py of the modem's developer: it waits 0.5 s for an answer. The last commands are not in the emulated modem.
NM3 = [
    Step(1, *STATUS, wait_s=0.5),
    Step(1, b"$A001", rb"#A001\r\n", wait_s=0.5),
    Step(1, b"$P002", rb"\$P002\r\n#R002T03200\r\n"),
    Step(1, b"$P009", rb"\$P009\r\n#TO\r\n"),
    Step(1, b"$B05hello", rb"\$B05\r\n", rb"#B00105hello\r\n"),
    Step(1, b"$U00205hello", rb"\$U00205\r\n", rb"#U05hello\r\n"),
    Step(1, b"$M00264" + DATA, rb"\$M00264\r\n#R002T03200\r\n", rb"#U64" + re.escape(DATA) + rb"\r\n"),
    Step(1, b"$B02abT00000000012345", rb"\$B02\r\n", rb"#B00102ab\r\n"),
    *(
        step
        for command in (b"$N", b"$S", b"$XTG", b"$XTE", b"$XTD", b"$XTC", b"$CM002", b"$CC002", b"$R")
        for step in (Step(1, command, rb"E\r\n", wait_s=0.5), Step(1, *STATUS, wait_s=0.5))
    ),
    *(Step(1, command + b"$?", rb"E\r\n" + STATUS[1], wait_s=0.0) for command in (b"$N", b"$XTG", b"$R")),
]


def test_session_of_the_public_driver_is_answered() -> None:
    replay(Hosts("nano"), NM3)
