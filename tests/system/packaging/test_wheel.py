"""The wheel: its files, and its use in an empty environment, without extras and with other versions of Python."""

import importlib.metadata
import json
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from builders.common import REPOSITORY
from packaging.requirements import Requirement

from sonarpost.extensions.simulation.demo.settings import PLATFORM_OF
from sonarpost.sonar.image_files import write_png


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(REPOSITORY)]
    subprocess.run(command, check=True, capture_output=True)
    [path] = folder.glob("*.whl")
    return path


LEAFLET = "sonarpost/services/console/static/vendor/leaflet/"
SUFFIXES = ".py .typed .tiles .model .json .json5 .toml .service .target .conf .md .html .css .js .svg"


def wanted():
    """Return the files of the source tree that belong into the wheel."""
    common = REPOSITORY / "common"
    files = {path.relative_to(common).as_posix() for path in (common / "sonarpost").rglob("*")}
    files |= {f"sonarpost/{p.relative_to(REPOSITORY).as_posix()}" for p in (REPOSITORY / "services").rglob("*")}
    files |= {f"sonarpost/cli/deployment/examples/{path.name}" for path in (REPOSITORY / "config").iterdir()}
    return {name for name in files if name.endswith((*SUFFIXES.split(),)) and "__pycache__" not in name}


def test_the_wheel_holds_what_runs_and_nothing_else(wheel):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert wanted() | {LEAFLET + name for name in ("leaflet.js", "leaflet.css", "LICENSE.md")} <= names
    assert any(name.endswith("licenses/LICENSE") for name in names)
    folders = {name.partition("/")[0] for name in names}
    assert [name.partition("-")[0] for name in sorted(folders)] == ["sonarpost", "sonarpost"]
    assert [name for name in names if "__pycache__" in name] == []


def closure(requirements):
    """Return the names of the distributions that requirements without extras need, dependencies included."""
    found = set[str]()
    for requirement in map(Requirement, requirements or ()):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            found |= {requirement.name} | closure(importlib.metadata.requires(requirement.name))
    return found


@pytest.fixture(scope="module")
def minimal(wheel, tmp_path_factory):
    """Return the programs of an environment with the wheel and, as links, its dependencies without any extra."""
    environment = tmp_path_factory.mktemp("minimal")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(environment)], check=True)
    pip = [sys.executable, "-m", "pip", "--python", str(environment / "bin" / "python"), "install", "--no-deps"]
    subprocess.run([*pip, "--no-index", "--quiet", str(wheel)], check=True)
    [site] = environment.glob("lib/python3*/site-packages")
    [metadata] = site.glob("sonarpost-*.dist-info")
    names = closure(importlib.metadata.Distribution.at(metadata).requires)
    assert {"numpy", "eclipse-zenoh"} <= names
    assert not {"starlette", "uvicorn", "matplotlib"} & names
    for name in names:
        link_distribution(name, site)
    return environment / "bin"


def link_distribution(name, site):
    distribution = importlib.metadata.distribution(name)
    for first in {file.parts[0] for file in distribution.files} - {"..", "__pycache__"}:
        source = Path(str(distribution.locate_file(first)))
        if not (site / first).exists():
            (site / first).symlink_to(source)


def run(program, *arguments, status=0, cwd, **environment):
    """Run a program; return its output and, after it, what it reports."""
    result = subprocess.run(
        [str(program), *arguments],
        cwd=cwd,
        env={"PATH": "/usr/bin:/bin", "HOME": str(cwd), **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == status, result.stderr
    return result.stdout + result.stderr


def use_the_codecs_and_the_detector(programs, folder):
    image = np.random.default_rng(1).gamma(4.0, 25.0, size=(80, 140)).clip(0, 255).astype(np.uint8)
    write_png(folder / "contact.png", image)
    sonarpost = programs / "sonarpost"
    for codec in ("emb", "vq"):
        run(sonarpost, "encode", "contact.png", "--codec", codec, "--out", codec, cwd=folder)
        run(sonarpost, "decode", f"{codec}/contact.{codec}", "--out", codec, cwd=folder)
        assert (folder / codec / "contact.tiff").is_file()
    run(sonarpost, "simulate", "line.xtf", "--pings", "400", cwd=folder)
    printed = run(sonarpost, "detect", "line.xtf", "--json", cwd=folder)
    # On a slow machine progress follows.
    assert json.JSONDecoder().raw_decode(printed)[0]["files"]


def test_the_codecs_the_detector_and_the_services_of_the_chain_need_no_extra(minimal, tmp_path):
    use_the_codecs_and_the_detector(minimal, tmp_path)
    (tmp_path / "empty.toml").touch()
    for service in PLATFORM_OF:
        printed = run(minimal / "sonarpost", "run", service, "--config", "empty.toml", status=2, cwd=tmp_path)
        assert "empty.toml: platform" in printed, "the configuration is read after all modules were imported"
    assert run(minimal / "sonarpost", "console", "user", "ls", "--state-dir", "state", cwd=tmp_path) == ""


@pytest.mark.chain
def test_the_whole_chain_runs_without_an_extra(minimal, tmp_path):
    printed = run(minimal / "sonarpost", "demo", "--time-scale", "60", "--json", cwd=tmp_path)
    outcome = json.loads(next(line for line in printed.splitlines() if line.startswith("{")))
    assert outcome["images_shore"] == outcome["images_complete"] > 0


def test_a_command_without_its_extra_says_how_to_install_it(minimal, tmp_path):
    for command, *arguments in (
        ("console", "training", "3"),
        ("run", "console", "--config", "x.toml"),
        ("demo", "--console"),
    ):
        printed = run(minimal / "sonarpost", command, *arguments, status=2, cwd=tmp_path)
        assert printed == f"sonarpost {command}: needs the extra console: pip install 'sonarpost[console]'\n"


def interpreter(version):
    """Return an interpreter of a version from PATH, or else from pyenv."""
    found = shutil.which(f"python{version}")
    installed = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python"))
    works = found and subprocess.run([found, "--version"], capture_output=True, check=False).returncode == 0
    return found if works else str(installed[-1]) if installed else None


@pytest.mark.parametrize("python", [*filter(None, map(interpreter, ("3.12", "3.13")))])  # the others run in 3.11
def test_the_wheel_runs_with_the_locked_packages(python, wheel, tmp_path):
    environment = tmp_path / "environment"
    subprocess.run([python, "-m", "venv", str(environment)], check=True)
    pip = [str(environment / "bin" / "python"), "-m", "pip", "--quiet", "--disable-pip-version-check", "install"]
    lock = str(REPOSITORY / "requirements.lock")
    installed = subprocess.run(
        [*pip, "--require-hashes", "--only-binary", ":all:", "-r", lock], capture_output=True, text=True, check=False
    )
    if "No matching distribution" in installed.stderr or "Failed to establish" in installed.stderr:
        pytest.skip(f"the package index does not have the locked packages: {installed.stderr.splitlines()[-1]}")
    assert installed.returncode == 0, installed.stderr
    subprocess.run([*pip, "--no-deps", "--no-index", str(wheel)], check=True)
    use_the_codecs_and_the_detector(environment / "bin", tmp_path)
