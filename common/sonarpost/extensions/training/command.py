"""`sonarpost console training`: a console with simulated contacts."""

import argparse
import tempfile
from contextlib import ExitStack, closing
from pathlib import Path

from sonarpost.cli.console import add_page_options, serve_page
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import option
from sonarpost.errors import ConfigError
from sonarpost.services.console.config import ConsoleConfig
from sonarpost.services.console.store.database import DATABASE_NAME, Database

USERS = (("watch", "observer"), ("op", "operator"), ("expert", "expert"))
MAX_CONTACTS = 100_000


def add_options(parser: CommandParser) -> None:
    """Add the options."""
    option(parser, "contacts N", "number of simulated contacts", int)
    option(parser, "--state DIR", "folder for the training data (default: none)", Path)
    option(parser, "--seed", "seed of the simulation", int, 1)
    option(parser, "--interval S", "time between packets", float, 6.0)
    add_page_options(parser)
    parser.set_defaults(run=run)


def run(parsed: argparse.Namespace) -> int:
    """Serve the page until a signal; return 0.

    Raises:
        ConfigError: The number of contacts is out of range.
        PortError: The address cannot be bound.
    """
    if not 1 <= parsed.contacts <= MAX_CONTACTS:
        raise ConfigError("console training", "N", parsed.contacts, f"1 to {MAX_CONTACTS}")
    # Imported lazily: the help of the command needs neither the codecs nor the simulation.
    from sonarpost.extensions.training.simulator import RATE, VESSEL, TrainingSimulator  # noqa: PLC0415
    from sonarpost.services.console.state import ConsoleState  # noqa: PLC0415

    config = ConsoleConfig(vessel_lat_deg=56.4495, vessel_lon_deg=-5.6012, assumed_rate=RATE)
    with ExitStack() as stack:
        scratch = stack.enter_context(tempfile.TemporaryDirectory(prefix="sonarpost-training-"))
        folder: Path = parsed.state or Path(scratch)
        state = ConsoleState(config, stack.enter_context(closing(Database(folder / DATABASE_NAME))))
        simulator = TrainingSimulator(state, parsed.contacts, parsed.seed, parsed.interval)

        def start() -> None:
            stack.callback(simulator.stop)
            simulator.load_backlog(parsed.contacts * 2 // 3)
            simulator.start()

        note = "All contacts are simulated. Ctrl-C ends the training."
        serve_page(parsed, state, folder, USERS, VESSEL, note, start, training=True)
    return 0
