"""MCAP files: `sonarpost record` and `sonarpost replay`."""

from typing import Final

from sonarpost.cli.parsing.commands import CommandSpec

_EXTRAS: Final = {"lz4": "mcap", "mcap": "mcap", "zstandard": "mcap"}

RECORD: Final = CommandSpec(
    "record the keys of a router into an MCAP file",
    "sonarpost.extensions.mcap.record:add_record",
    "dive.mcap --router tcp/127.0.0.1:7447 --duration 3600",
    _EXTRAS,
)
REPLAY: Final = CommandSpec(
    "publish the records of an MCAP file again, or send them to a c2",
    "sonarpost.extensions.mcap.record:add_replay",
    "dive.mcap --router tcp/127.0.0.1:7447 --to-c2 --speed 0",
    _EXTRAS,
)
