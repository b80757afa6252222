"""`sonarpost run SERVICE --config FILE`, `sonarpost run all --config FILE` and `sonarpost router`."""

import argparse
import json
import os
import runpy
import sys
from pathlib import Path

from sonarpost import logs
from sonarpost.bus import router
from sonarpost.cli.deployment import run_all
from sonarpost.cli.parsing.parser import CommandParser
from sonarpost.cli.shared import add_survey_options, log_level, option, survey_options_of
from sonarpost.config import ENVIRONMENT_PREFIX, service_packages
from sonarpost.errors import ConfigError

_DESCRIPTION = """Run one service until Ctrl-C, or all services that have a table in the file: a test on a bench needs
one terminal for each platform. With all, an embedded router is started as well if `router` names an endpoint of this
host on which no router listens. Each line of the output begins with the name of its process. A process that ends is
restarted after 1, 2, 4, ... 60 s; one that ends with status 2, an invalid configuration, stops all. For operation use
systemd (`sonarpost install-units`)."""


def add_run(parser: CommandParser) -> None:
    """Add the options of `run`."""
    parser.description = _DESCRIPTION
    option(parser, "service", "name of the service, or all", choices=("all", *service_packages()))
    option(parser, "--config FILE", "TOML file of the platform", Path, required=True)
    add_survey_options(parser)
    run_all.add_options(parser)
    parser.set_defaults(run=run_service)


def add_router(parser: CommandParser) -> None:
    """Add the options of `router`."""
    parser.description = router.__doc__
    router.add_arguments(parser)
    parser.set_defaults(run=run_router)


def run_service(parsed: argparse.Namespace) -> int:
    """Run the service's own package, as `python -m PACKAGE` does, or all services.

    Raises:
        ConfigError: Invalid survey options, or options for another service than the given one.
    """
    os.environ.update(_survey_overrides(parsed))
    if parsed.service == "all":
        return run_all.run(parsed)
    if parsed.router_config is not None or parsed.listen:
        raise ConfigError("command line", "--router-config or --listen", parsed.service, "the service all")
    sys.argv[1:] = ["--config", str(parsed.config)]
    runpy.run_module(service_packages()[parsed.service], run_name="__main__", alter_sys=True)
    return 0


def _survey_overrides(parsed: argparse.Namespace) -> dict[str, str]:
    """Return --options and --crs as environment variables, which override the configuration file."""
    given = parsed.options or parsed.crs
    if given is None:
        return {}
    if parsed.service not in ("atd_stub", "all"):
        raise ConfigError(f"run {parsed.service}", "--options, --crs", given, "survey options for atd_stub only")
    crs = survey_options_of(parsed).projected_crs
    values = {"SURVEY_OPTIONS": parsed.options, "PROJECTED_CRS": crs}
    return {
        f"{ENVIRONMENT_PREFIX}ATD_STUB__{name}": json.dumps(str(v), ensure_ascii=False)
        for name, v in values.items()
        if v is not None
    }


def run_router(parsed: argparse.Namespace) -> int:
    """Run an embedded router."""
    logs.configure_logging("router", log_level(parsed))
    return router.run_parsed(parsed)
