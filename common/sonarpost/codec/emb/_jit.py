"""Compile a function to machine code, without losing its type.

Modules that use this import numba and are themselves imported only when a picture is coded: `sonarpost --help` must not
wait for a compiler.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def jit(function: Callable[P, R]) -> Callable[P, R]:
    """Return `function` compiled on first call; the machine code is kept on disk beside the module where possible.

    A cached function is not compiled anew when another module that it calls changes, so compiled functions call only
    functions of their own module.
    """
    return cast(Callable[P, R], numba.njit(cache=True)(function))
