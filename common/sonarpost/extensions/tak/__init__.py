"""TAK: Cursor-on-Target events, their delivery to servers, and data packages with images."""

from typing import Final

from sonarpost.cli.parsing.commands import CommandSpec

COT: Final = CommandSpec(
    "send the contacts of a shore site to a TAK endpoint, live, until Ctrl-C, or once",
    "sonarpost.extensions.tak.command:add_options",
    "tls://tak.example:8089 --tak-api https://tak.example:8443 --stored",
)
