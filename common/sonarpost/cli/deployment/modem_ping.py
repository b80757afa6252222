"""`sonarpost modem ping`: ask a modem for the acoustic travel time to another one, without any service."""

import argparse
import queue
import time

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import option
from sonarpost.errors import ConfigError, PortError
from sonarpost.modem import interface as ev
from sonarpost.modem.interface import ModemEvent, RangeMeasured
from sonarpost.modem.registry import DEFAULT_DRIVER, ModemSettings, modem_driver
from sonarpost.runtime.modem_port import open_modem_port
from sonarpost.runtime.modem_runner import ModemRunner
from sonarpost.runtime.serial_device import IN_USE
from sonarpost.runtime.serial_port import ModemPort

EXIT_UNANSWERED = 1
SOUND_SPEED_M_PER_S = 1500.0
POLL_S = 0.2
PING_TIMEOUT_S = 60.0
"""Maximum time of one ping; the driver itself gives up earlier."""

_PING = """Configure a modem as the services do, and ping another modem through the water. Stop the service that uses
the port first. Exit status: 0 if every ping was answered, 1 if one was not, 2 if the port is
in use or the modem itself does not reply."""


def add_actions(parser: CommandParser) -> None:
    """Add the command and its action."""
    ping = parser.add_action(
        "ping",
        "measure the travel time to another modem",
        run,
        "--port /dev/ttyUSB0 --address 3 --destination 1",
        _PING,
    )
    option(ping, "--port URL", "as in the configuration, for example /dev/ttyUSB0", required=True)
    option(ping, "--baud B", "of the serial line", int, 19200)
    option(ping, "--address N", "address to give to this modem", int, required=True)
    option(ping, "--driver NAME", "of the modem", default=DEFAULT_DRIVER)
    option(ping, "--destination N", "address of the other modem", int, required=True)
    option(ping, "--count N", "number of pings", int, 3)
    option(ping, "--wait S", "maximum wait for this modem", float, 30.0)


def run(parsed: argparse.Namespace) -> int:
    """Ping; print one line for each ping.

    Raises:
        ConfigError: An option is out of range, or the kind of port is not supported.
        PortError: The port is in use or cannot be opened, or the modem does not reply.
    """
    driver = modem_driver(parsed.driver)
    low, high = driver.capabilities.min_address, driver.capabilities.max_address
    if not driver.capabilities.ranging:
        raise ConfigError("command line", "--driver", parsed.driver, "a modem that measures ranges")
    if not low <= parsed.destination <= high or parsed.destination == parsed.address:
        expected = f"{low}..{high}, another one than --address"
        raise ConfigError("command line", "--destination", parsed.destination, expected)
    events: queue.SimpleQueue[ModemEvent] = queue.SimpleQueue()
    port = open_modem_port(parsed.port, parsed.baud)
    runner = ModemRunner(
        driver.create(ModemSettings(parsed.address, stream=port.STREAM), parsed.port), port, events.put
    )
    runner.start()
    try:
        _wait_until_ready(events, port, parsed.wait)
        answered = sum(_ping(runner, events, parsed.destination, number) for number in range(1, parsed.count + 1))
    finally:
        runner.stop()
    print(f"{answered} of {parsed.count} pings answered")
    return 0 if answered == parsed.count else EXIT_UNANSWERED


def _wait_until_ready(events: queue.SimpleQueue[ModemEvent], port: ModemPort, wait_s: float) -> None:
    deadline_s = time.monotonic() + wait_s
    waiting_for = ""
    while True:
        try:
            event = events.get(timeout=min(POLL_S, max(0.0, deadline_s - time.monotonic())))
        except queue.Empty:
            if time.monotonic() < deadline_s and not (port.error or "").startswith(IN_USE):
                continue
            reason = port.error if not port.is_open else f"the modem does not reply{waiting_for}"
            raise PortError(f"{port.url}: {reason or 'not open yet'}") from None
        match event:
            case ev.ModemReady():
                print(f"modem ready: address {event.address}, firmware {event.firmware or 'unknown'}", flush=True)
                return
            case ev.ModemUnresponsive():
                waiting_for = f" to {event.waiting_for}"
            case ev.SettingUnconfirmed():
                print(f"modem did not confirm a setting: {event.command}", flush=True)
            case _:
                pass


def _ping(runner: ModemRunner, events: queue.SimpleQueue[ModemEvent], destination: int, number: int) -> bool:
    """Send one ping, print its result and return whether it was answered."""
    while not events.empty():
        events.get()  # of an earlier ping
    request = runner.request(lambda driver, now: driver.ping(destination, now))
    travel_s: float | None = None
    deadline_s = time.monotonic() + PING_TIMEOUT_S
    reason = "no end of the request"
    while (left_s := deadline_s - time.monotonic()) > 0:
        try:
            event = events.get(timeout=left_s)
        except queue.Empty:
            break
        match event:
            case RangeMeasured(src=source) if source == destination:
                travel_s = event.travel_s
            case ev.RequestDone(request_id=done) if done == request:
                print(f"ping {number}: {_travel_text(travel_s)}", flush=True)
                return True
            case ev.RequestFailed(request_id=failed) if failed == request:
                reason = str(event.reason)
                break
            case ev.ModemError():
                print(f"modem reports an error: {event.text}", flush=True)
            case _:
                pass
    print(f"ping {number}: not answered ({reason})", flush=True)
    return False


def _travel_text(travel_s: float | None) -> str:
    if travel_s is None:
        return "answered, without a travel time"
    return f"one way {travel_s:.4f} s, {travel_s * SOUND_SPEED_M_PER_S:.1f} m at {SOUND_SPEED_M_PER_S:.0f} m/s"
