"""Sessions of hosts with emulated modems, and what the suite of all emulated modems sends to each."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sonarpost.extensions.simulation.channel.acoustics import LocalPosition
from sonarpost.extensions.simulation.channel.parameters import build_parameters
from sonarpost.extensions.simulation.channel.simulator import ChannelSimulator, PlacedModem
from sonarpost.extensions.simulation.modem.settings import EmulatedModemConfig


class Hosts:
    """Hosts of emulated modems, 1 and 2 or more, with 150 m between neighbours: the travel takes 0.1 s."""

    def __init__(self, driver: str, modems: int = 2, **parameters: float) -> None:
        places = {
            number: PlacedModem(EmulatedModemConfig(number, driver=driver), LocalPosition(150.0 * number))
            for number in range(1, modems + 1)
        }
        self.simulator = ChannelSimulator(build_parameters(parameters, "test"), places)

    def say(self, number: int, data: bytes) -> None:
        self.simulator.receive(number, data, self.simulator.now)

    def hear(self, number: int, wait_s: float = 0.0) -> bytes:
        """Return what a host has received since the last call, after some simulated time."""
        self.simulator.advance(self.simulator.now + wait_s)
        outputs = self.simulator.take_outputs(number)
        assert all(output.data for output in outputs), "an output without bytes"
        return b"".join(output.data for output in outputs)


@dataclass(frozen=True)
class Step:
    """A host sends bytes; both hosts then receive what the patterns describe.

    Attributes:
        modem: Number of the modem.
        sent: Bytes of its host.
        answer: Pattern of what the modem answers within `wait_s`.
        arrives: Pattern of what the other modem's host receives.
    """

    modem: int
    sent: bytes
    answer: bytes
    arrives: bytes = b""
    wait_s: float = 15.0


def replay(hosts: Hosts, steps: Sequence[Step]) -> None:
    for step in steps:
        hosts.say(step.modem, step.sent)
        answer, arrives = hosts.hear(step.modem, step.wait_s), hosts.hear(3 - step.modem)
        assert re.fullmatch(step.answer, answer, re.DOTALL), (step, answer)
        assert re.fullmatch(step.arrives, arrives, re.DOTALL), (step, arrives)


@dataclass(frozen=True)
class HostInput:
    """What hosts of an emulated modem send.

    Attributes:
        commands: Commands, also cut ones.
        incomplete: The beginning of a command.
        question: A command that every modem answers.
        is_answered: Tells whether it was answered.
    """

    commands: Sequence[bytes]
    incomplete: bytes
    question: bytes
    is_answered: Callable[[Hosts], bool]


def hears(pattern: bytes) -> Callable[[Hosts], bool]:
    """Return a function that tells whether the host has received what a pattern describes."""
    return lambda hosts: re.search(pattern, hosts.hear(1)) is not None
