"""TAK: Cursor-on-Target events, their delivery to servers, and data packages with images."""

from typing import Final

from sonarpost.cli.parsing.commands import AddedCommand

COT: Final = AddedCommand(
    "send the contacts of a shore site to a TAK endpoint",
    "sonarpost.extensions.tak.command:add_parser",
    {"c2 cot": "c2 cot tls://tak.example:8089 --tak-api https://tak.example:8443 --archive out"},
)
