"""GDAL as an independent reader in `make test-system`: its programs and its bindings, of the system's Python."""

import functools
import json
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

SYSTEM_PYTHON = Path("/usr/bin/python3")


def _needs(condition: str | bool, what: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    absent = pytest.mark.skipif(condition, reason=f"{what} not installed")
    return lambda test: pytest.mark.system(absent(test))


@functools.cache
def has_bindings() -> bool:
    command = [SYSTEM_PYTHON, "-c", "import osgeo_utils.samples"]
    return SYSTEM_PYTHON.exists() and subprocess.run(command, capture_output=True, check=False).returncode == 0


needs_gdal = _needs(shutil.which("gdaltransform") is None, "GDAL's programs are")
needs_ogr = _needs(shutil.which("ogrinfo") is None, "ogrinfo (gdal-bin) is")
# As text it is evaluated only where such a test runs.
needs_bindings = _needs("not gdal.has_bindings()", "GDAL's Python programs are")

_VALIDATE = (
    "from osgeo_utils.samples import validate_cloud_optimized_geotiff as v; import sys;"
    "print(v.validate(sys.argv[1], full_check=True)[:2])"
)


def cloud_optimised_problems(path: Path) -> str:
    """Return the errors and warnings of GDAL's validator, `([], [])` without any."""
    command = [SYSTEM_PYTHON, "-c", _VALIDATE, path]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()


def info(path: Path) -> dict[str, Any]:
    """Return the description of an image by `gdalinfo`."""
    ran = subprocess.run(["gdalinfo", "-json", path], check=True, capture_output=True)
    found: dict[str, Any] = json.loads(ran.stdout)
    return found


def pixels(path: Path, places: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return column and row of positions, given as latitude and longitude, by `gdaltransform`."""
    lines = "".join(f"{lon_deg!r} {lat_deg!r}\n" for lat_deg, lon_deg in places)
    wkt = info(path)["coordinateSystem"]["wkt"]
    command = ["gdaltransform", "-s_srs", "OGC:CRS84", "-t_srs", wkt, "-output_xy"]
    metres = subprocess.run(command, input=lines, check=True, capture_output=True, text=True).stdout
    command = ["gdaltransform", "-i", "-output_xy", path]
    ran = subprocess.run(command, input=metres, check=True, capture_output=True, text=True)
    return [(float(column), float(row)) for column, row in map(str.split, ran.stdout.splitlines())]
