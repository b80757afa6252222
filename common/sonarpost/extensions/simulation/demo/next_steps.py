"""Where a demo's results are, and commands that use them, as lines to paste into a terminal in the same folder."""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import sys
from pathlib import Path

from sonarpost.extensions.simulation.demo.settings import ChainSettings

SUBSCRIBER = Path("examples/shore_subscriber.py")


def routers_line(settings: ChainSettings) -> str:
    """Return the endpoints of the three routers."""
    names = ("vehicle", "vessel", "shore site")
    endpoints = (f"{name} tcp/127.0.0.1:{port}" for name, port in zip(names, settings.router_ports, strict=True))
    return f"routers: {', '.join(endpoints)}"


def folder_lines(settings: ChainSettings) -> tuple[str, ...]:
    """Return the folders of the images on both sides."""
    return (
        f"images at the vessel: {shown(settings.vessel_images)}",
        f"images at the shore site: {shown(settings.shore_images)}",
    )


def commands(settings: ChainSettings, *, running: bool) -> tuple[tuple[str, str], ...]:
    """Return commands for the time after the demo, each with its purpose.

    Args:
        settings: Settings of the chain.
        running: Whether the chain keeps running.
    """
    images = settings.shore_images.parent
    sonarpost = program("sonarpost")
    # `c2 ls` finds the folder of a demo in the current folder.
    is_default = images == Path("demo-out/shore/images").absolute()
    ls = (sonarpost, "c2", "ls", *(() if is_default else ("--archive", shown(images))))
    found = [(ls, "list the contacts at the shore site")]
    if importlib.util.find_spec("uvicorn") is not None:  # the extra `console` is installed
        found.append(((sonarpost, "console", "--view", shown(images)), "show them in a browser; Ctrl-C ends it"))
    endpoint = f"tcp/127.0.0.1:{settings.router_ports[2]}"
    purpose = "print contacts as they arrive" + ("" if running else ": start it, then another demo")
    if SUBSCRIBER.is_file():
        python = shown(Path(sys.executable))
        found.append(((python, str(SUBSCRIBER), endpoint, shown(settings.folder)), purpose))
    else:
        found.append(((sonarpost, "c2", "watch", "--router", endpoint), purpose))
    if running and settings.mode == "survey":
        survey = shown(settings.incoming / "next.xtf")
        found.append(((sonarpost, "simulate", survey, "--seed", str(settings.seed + 1)), "send another survey"))
    return tuple((shlex.join(words), purpose) for words, purpose in found)


def program(name: str) -> str:
    """Return how another terminal calls a program of this environment: by its name if it is on the PATH, else its path.

    An activated virtual environment does not count: it is activated in this terminal only.
    """
    own = Path(sys.executable).parent / name
    activated = os.environ.get("VIRTUAL_ENV")
    folders = os.environ.get("PATH", "").split(os.pathsep)
    elsewhere = os.pathsep.join(f for f in folders if not activated or Path(f) != Path(activated, "bin"))
    found = shutil.which(name, path=elsewhere)
    return name if found is not None and Path(found).resolve() == own.resolve() else shown(own)


def shown(path: Path) -> str:
    """Return a path, relative if it is in the current folder."""
    try:
        return str(path.absolute().relative_to(Path.cwd()))
    except ValueError:
        return str(path)
