"""Compile the functions of the codecs to one extension module beside `sonarpost/codec`, so that numba is not needed.

    python packaging/compile_codecs.py

Needs numba, compilers for C and C++ (numba tries both), the headers of Python, and setuptools. With
NUMBA_CPU_NAME=generic the module works on any processor of the architecture. Afterwards numba and llvmlite can be
removed from the installation.
"""

import json
import os
import tempfile
import warnings
from collections.abc import Callable
from typing import Any

from numba.core import errors, types
from numba.np.numpy_support import as_dtype

from sonarpost.codec import compiled_library
from sonarpost.codec.jit import compiled_functions
from sonarpost.codec.machine_code import prepare_machine_code

with warnings.catch_warnings():
    # numba will remove pycc when it has a successor.
    warnings.simplefilter("ignore", errors.NumbaPendingDeprecationWarning)
    from numba.pycc import CC


def described(argument: Any) -> Any:  # noqa: ANN401 types of numba, JSON
    """Return a type of numba in the form that `compiled_library.types_from_table` reads.

    Raises:
        TypeError: The library does not support it.
    """
    if isinstance(argument, types.Array) and argument.layout in "CA":
        is_contiguous = argument.layout == "C"
        return {"dtype": as_dtype(argument.dtype).str, "ndim": argument.ndim, "contiguous": is_contiguous}
    if isinstance(argument, types.BaseTuple):
        return [described(each) for each in argument]
    if argument == types.int64:
        return "int"
    raise TypeError(f"argument: got {argument}, expected an array, a tuple or int64")


def caller(function: Callable[..., Any], arguments: int) -> Callable[..., Any]:
    """Return a Python function that calls a compiled one; with `*args` numba would pass a tuple."""
    names = ", ".join(f"a{number}" for number in range(arguments))
    return eval(f"lambda {names}: function({names})", {"function": function})  # type: ignore[no-any-return]  # noqa: S307


def main() -> None:
    """Compile all functions that the codecs use, with the options of `sonarpost.codec.jit`."""
    with tempfile.TemporaryDirectory() as folder:
        # Without stored code, numba lists the functions that others call as well.
        os.environ["NUMBA_CACHE_DIR"] = folder
        prepare_machine_code(print)
        compile_library()


def compile_library() -> None:
    """Write the extension module and its table."""
    library = CC(compiled_library.MODULE)
    library.output_dir = str(compiled_library.FOLDER)
    library.target_cpu = "generic"
    table = []
    for dispatcher in compiled_functions:
        name = compiled_library.full_name(dispatcher.py_func)
        for compiled in dispatcher.overloads.values():
            entry, signature = f"function_{len(table)}", compiled.signature
            library.export(entry, signature)(caller(dispatcher, len(signature.args)))
            arguments = [described(argument) for argument in signature.args]
            table.append({"function": name, "arguments": arguments, "entry": entry})
    library.compile()
    (compiled_library.FOLDER / compiled_library.TABLE).write_text(json.dumps(table))
    print(f"{len(table)} functions in {compiled_library.FOLDER / library.output_file}")


if __name__ == "__main__":
    main()
