"""What the tests of extensions add to suites of the core."""

from importlib import import_module
from types import ModuleType

from builders.common import REPOSITORY


def modules(name: str) -> list[ModuleType]:
    """Return the modules of a name in the tests of all extensions."""
    paths = sorted((REPOSITORY / "tests" / "extensions").glob(f"*/{name}.py"))
    return [import_module(f"extensions.{path.parent.name}.{name}") for path in paths]
