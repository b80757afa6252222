"""GDAL as an independent reader: its programs and its Python bindings, which belong to the system's Python."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

SYSTEM_PYTHON = Path("/usr/bin/python3")

needs_gdal = pytest.mark.skipif(shutil.which("gdaltransform") is None, reason="GDAL's programs are not installed")
needs_ogr = pytest.mark.skipif(shutil.which("ogrinfo") is None, reason="ogrinfo (gdal-bin) is not installed")


def _has_bindings() -> bool:
    command = [SYSTEM_PYTHON, "-c", "import osgeo_utils.samples"]
    return SYSTEM_PYTHON.exists() and subprocess.run(command, capture_output=True, check=False).returncode == 0


needs_bindings = pytest.mark.skipif(not _has_bindings(), reason="GDAL's Python programs are not installed")

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
    command = ["gdaltransform", "-s_srs", "OGC:CRS84", "-t_srs", _wkt(path), "-output_xy"]
    metres = subprocess.run(command, input=lines, check=True, capture_output=True, text=True).stdout
    ran = subprocess.run(
        ["gdaltransform", "-i", "-output_xy", path], input=metres, check=True, capture_output=True, text=True
    )
    return [(float(column), float(row)) for column, row in map(str.split, ran.stdout.splitlines())]


def _wkt(path: Path) -> str:
    wkt: str = info(path)["coordinateSystem"]["wkt"]
    return wkt
