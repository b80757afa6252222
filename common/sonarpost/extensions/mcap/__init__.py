"""MCAP files: `sonarpost record` and `sonarpost replay`."""

from typing import Final

from sonarpost.cli.parsing.commands import AddedCommand

_EXTRAS: Final = {"lz4": "mcap", "mcap": "mcap", "zstandard": "mcap"}

RECORD: Final = AddedCommand(
    "record the keys of a router into an MCAP file",
    "sonarpost.extensions.mcap.record:add_record",
    {"record": "record dive.mcap --router tcp/127.0.0.1:7447 --duration 3600"},
    _EXTRAS,
)
REPLAY: Final = AddedCommand(
    "publish the records of an MCAP file again, or send them to a c2",
    "sonarpost.extensions.mcap.record:add_replay",
    {"replay": "replay dive.mcap --router tcp/127.0.0.1:7447 --to-c2 --speed 0"},
    _EXTRAS,
)
