"""`sonarpost survey view`: a local web page with the waterfall of a recording, for picks."""

from typing import Final

from sonarpost.cli.parsing.commands import CommandSpec

VIEW: Final = CommandSpec(
    "show a recording on a web page, and pick contacts in it",
    "sonarpost.extensions.survey_view.command:add_options",
    "line.xtf --out line.xtf.picks",
)
