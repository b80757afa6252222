"""The compiled functions of the codecs as one extension module, for installations without numba.

`packaging/compile_codecs.py` writes the module and a table of its functions beside this file; the container image
contains them instead of numba and its compiler. An installation with numba does not use them.
"""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np

MODULE: Final = "sonarpost_codec_functions"
FOLDER: Final = Path(__file__).parent
TABLE: Final = f"{MODULE}.json"
"""Name of the table: full name of a Python function, types of the arguments, name in the extension module."""

Function = Callable[..., Any]
Types = tuple[Any, ...]
"""Types of arguments: `int`, (dtype, dimensions, whether contiguous) of an array, `Types` of a tuple."""


def is_needed() -> bool:
    """Return whether numba is not installed."""
    return importlib.util.find_spec("numba") is None


class LibraryFunction:
    """A function with one implementation for each combination of argument types.

    The implementations do not check the types of arrays themselves: another type would be read as the expected one.

    Args:
        name: Full name of the Python function, for errors.
        implementations: By the types of the arguments.
    """

    def __init__(self, name: str, implementations: Mapping[Types, Function]) -> None:
        self._name = name
        self._implementations = implementations

    def __call__(self, *arguments: object) -> Any:  # noqa: ANN401 as the Python function
        """Call the implementation for the types of the arguments.

        Raises:
            TypeError: There is none.
        """
        types = argument_types(arguments)
        implementation = self._implementations.get(types)
        if implementation is None:
            expected = " or ".join(map(str, self._implementations)) or "no call: only compiled functions call it"
            raise TypeError(f"{self._name}: arguments: got {types}, expected {expected}")
        return implementation(*arguments)


def argument_types(arguments: Sequence[object]) -> Types:
    """Return the types of arguments; integers of any kind are `int`."""
    # Tuples instead of text: an image needs some hundred calls with dozens of arrays.
    types: list[Any] = []
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            types.append((argument.dtype, argument.ndim, argument.flags.c_contiguous))
        elif isinstance(argument, tuple):
            types.append(argument_types(argument))
        else:
            types.append(int if isinstance(argument, (int, np.integer)) else type(argument))
    return tuple(types)


def types_from_table(described: Sequence[Any]) -> Types:
    """Return types from their JSON form: `int`, `{"dtype": "<i4", "ndim": 2, "contiguous": true}`, lists for tuples."""
    return tuple(_type_from_table(each) for each in described)


def _type_from_table(described: Any) -> Any:  # noqa: ANN401 JSON
    if described == "int":
        return int
    if isinstance(described, list):
        return types_from_table(described)
    return np.dtype(described["dtype"]), described["ndim"], described["contiguous"]


def library_function(function: Function) -> LibraryFunction:
    """Return the compiled form of a Python function; without implementations if only compiled functions call it.

    Raises:
        ModuleNotFoundError: There is no library.
    """
    name = full_name(function)
    module, table = _library()
    rows = (row for row in table if row["function"] == name)
    return LibraryFunction(name, {types_from_table(row["arguments"]): getattr(module, row["entry"]) for row in rows})


def full_name(function: Function) -> str:
    """Return the name of a function in the table."""
    return f"{function.__module__}.{function.__qualname__}"


@cache
def _library() -> tuple[ModuleType, Sequence[Mapping[str, Any]]]:
    found = sorted(FOLDER.glob(f"{MODULE}.*.so"))
    if not found:
        raise ModuleNotFoundError(f"numba: got no such package, expected it or {MODULE}.*.so in {FOLDER}", name="numba")
    spec = importlib.util.spec_from_file_location(MODULE, found[0])
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module, json.loads((FOLDER / TABLE).read_text())
