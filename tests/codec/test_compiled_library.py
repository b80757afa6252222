"""Compiled functions of the codecs without numba, as in the container image."""

import os
import shutil
import subprocess
import sys
import sysconfig
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from builders.common import REPOSITORY

from sonarpost.codec import compiled_library, jit
from sonarpost.codec.compiled_library import LibraryFunction, argument_types, types_from_table

HIDDEN = "import sys; sys.modules['numba'] = sys.modules['llvmlite'] = None\n"
DIGEST = """
import sys
import check_image
print(check_image.try_every_codec(), "numba.core" in sys.modules)
"""


def run(code: str, *folders: Path) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(map(str, folders))}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the package of the codecs."""
    folder = tmp_path_factory.mktemp("package")
    shutil.copytree(REPOSITORY / "common" / "sonarpost", folder / "sonarpost")
    return folder


def test_without_numba_and_library_the_error_names_both(package: Path) -> None:
    done = run(f"{HIDDEN}import sonarpost.codec.emb.codec", package)
    assert done.returncode == 1
    assert "numba: got no such package, expected it or sonarpost_codec_functions.*.so in" in done.stderr


@pytest.mark.system
@pytest.mark.skipif(
    not (shutil.which("g++") and find_spec("setuptools") and Path(sysconfig.get_path("include"), "Python.h").exists()),
    reason="no g++, setuptools or headers of Python",
)
def test_library_has_the_streams_and_pixels_of_numba(package: Path) -> None:
    scripts = REPOSITORY / "packaging"
    compiled = run("import compile_codecs; compile_codecs.main()", package, scripts)
    assert compiled.returncode == 0, compiled.stderr
    assert (package / "sonarpost" / "codec" / compiled_library.TABLE).exists()
    with_numba, without = run(DIGEST, package, scripts), run(HIDDEN + DIGEST, package, scripts)
    assert with_numba.stdout.split()[1:] == ["True"], with_numba.stderr
    assert without.stdout.split() == [with_numba.stdout.split()[0], "False"], without.stderr


def test_implementation_is_chosen_by_the_types_of_the_arguments() -> None:
    described = ["int", [{"dtype": "<i4", "ndim": 1, "contiguous": True}, "int"]]
    by_types = {
        types_from_table(described): lambda number, pair: ("int32", number, pair[1]),
        types_from_table([*described, "int"]): lambda *_: "three",
    }
    function = LibraryFunction("module.name", by_types)
    array = np.zeros(4, np.int32)
    assert function(1, (array, np.int64(2))) == ("int32", 1, 2)
    assert function(1, (array, 2), 3) == "three"


@pytest.mark.parametrize(
    "argument",
    [np.zeros(4, np.int64), np.zeros(4, ">i4"), np.zeros((2, 2), np.int32), np.zeros(8, np.int32)[::2], 1, 1.0, None],
)
def test_other_types_are_refused(argument: object) -> None:
    accepted = argument_types([np.zeros(4, np.int32)])
    with pytest.raises(TypeError, match=r"module\.name: arguments: got .*, expected .*int32"):
        LibraryFunction("module.name", {accepted: lambda _: pytest.fail("called")})(argument)
    with pytest.raises(TypeError, match="expected no call: only compiled functions call it"):
        LibraryFunction("module.name", {})(1)


def test_library_is_not_used_with_numba() -> None:
    def add_one(number: int) -> int:
        return number + 1

    assert not compiled_library.is_needed()
    assert not isinstance(jit.jit(add_one), LibraryFunction)
