"""`sonarpost simulate`: write a simulated survey and its ground truth."""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.progress import ProgressDisplay
from sonarpost.cli.shared import flag, in_new_folder, option, projected_crs_of
from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed.survey import SimulatedSurvey, SurveySpec, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.extensions.simulation.seabed.xtf_writer import write_xtf
from sonarpost.files import write_atomically

TRUTH_SCHEMA = 1
_NUMBERS = {
    "seed": "seed of every random draw",
    "pings": "number of pings",
    "samples": "samples per side",
    "range_m": "slant range per side in metres",
    "altitude_m": "altitude in metres",
    "targets": "number of mine-like objects",
    "clutter": "number of other objects",
    "burial": "greatest fraction of an object's height below the seabed, 0 to 0.8",
    "scour": "depth of the pits around objects: 0 none, 1 typical",
}
"""Fields of the specification that are options."""


def add_options(parser: CommandParser) -> None:
    """Add the `simulate` command."""
    default = SurveySpec()
    parser.description = "Write a simulated side-scan survey as XTF. The same options give the same file."
    option(parser, "out OUT.xtf", "the file to create", Path)
    for name, text in _NUMBERS.items():
        value = getattr(default, name)
        option(parser, f"--{name.replace('_', '-')}", text, type(value), value)
    kinds = [kind.value for kind in SeabedKind]
    option(parser, "--seabed", "type of seabed", default=default.seabed.value, choices=kinds)
    option(parser, "--bits", "bits per sample", int, default.bits, choices=(8, 16))
    option(parser, "--truth FILE.json", "write the ground truth as JSON", Path)
    option(parser, "--crs EPSG:N", "write positions of this projected coordinate system, in place of degrees")
    flag(parser, "--force", "replace existing files")
    parser.set_defaults(run=run_simulate)


def run_simulate(args: argparse.Namespace) -> int:
    """Simulate and write a survey; print its summary.

    Raises:
        ConfigError: A file exists and --force is not given, its folder cannot be written, or --crs is invalid.
    """
    for path in filter(None, (args.out, args.truth)):
        if path.exists() and not args.force:
            raise ConfigError(str(path), "", "an existing file", "a new file, or --force to replace it")
        in_new_folder(path)
    crs = projected_crs_of(args)
    numbers = {name: getattr(args, name) for name in _NUMBERS}
    spec = SurveySpec(**numbers, seabed=SeabedKind(args.seabed), bits=args.bits)
    with ProgressDisplay(step=f"simulating {spec.pings} pings"):
        simulated = simulate_survey(spec)
    write_xtf(simulated.survey, args.out, crs)
    if args.truth is not None:
        write_atomically(args.truth, truth_json(simulated, args.out.name).encode())
    mines = sum(item.is_mine_like for item in simulated.truth)
    print(f"{args.out}: {spec.pings} pings, {mines} mine-like objects, {len(simulated.truth) - mines} others")
    return 0


def truth_json(simulated: SimulatedSurvey, survey_name: str) -> str:
    """Return the ground truth of a survey as a JSON document, one entry for each object on the seabed."""
    objects = [asdict(item) for item in simulated.truth]
    return json.dumps({"schema": TRUTH_SCHEMA, "survey": survey_name, "objects": objects}, indent=2) + "\n"
