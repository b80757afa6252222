"""Removes extensions from a copy of the source tree and runs the quick tests of the rest.

`python tests/check_extensions.py [NAME ...]`: each named extension with those that need it, or `all` of them together;
without a name, every one in turn, then all. A test whose module imports a removed extension is of that extension.
"""

import ast
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
EXTENSIONS = REPOSITORY / "common" / "sonarpost" / "extensions"
PACKAGE = "sonarpost.extensions."


def names() -> list[str]:
    """Return the names of all extensions."""
    return sorted(path.parent.name for path in EXTENSIONS.glob("*/entry_points.toml"))


def requirements(name: str) -> set[str]:
    """Return the extensions that an extension imports."""
    files = (EXTENSIONS / name).rglob("*.py")
    return {
        module.removeprefix(PACKAGE).partition(".")[0] for file in files for module in imports(file, nested=True)
    } & {*names()} - {name}


def removed_with(name: str) -> set[str]:
    """Return an extension and those that need it."""
    if name == "all":
        return {*names()}
    removed = {name}
    while more := {each for each in names() if requirements(each) & removed} - removed:
        removed |= more
    return removed


def is_for_types(node: ast.AST) -> bool:
    """Return whether a statement is `if TYPE_CHECKING`."""
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)


@cache
def imports(file: Path, *, nested: bool = False) -> frozenset[str]:
    """Return the modules that a file imports, by default when it is imported itself."""

    def walk(node: ast.AST) -> Iterator[str]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                yield from (alias.name for alias in child.names)
            elif isinstance(child, ast.ImportFrom) and child.module:
                yield child.module
                yield from (f"{child.module}.{alias.name}" for alias in child.names)
            elif nested or not (isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef)) or is_for_types(child)):
                yield from walk(child)

    return frozenset(walk(ast.parse(file.read_text(encoding="utf-8"))))


def needs(file: Path, removed: set[str], seen: set[Path]) -> bool:
    """Return whether the import of a file imports a removed extension."""
    if file in seen:
        return False
    seen.add(file)
    for module in imports(file):
        if module.startswith(PACKAGE) and module.removeprefix(PACKAGE).partition(".")[0] in removed:
            return True
        path = Path(*module.split("."))
        for root in (REPOSITORY, REPOSITORY / "tests", REPOSITORY / "packaging" / "docs"):
            for found in (root / path.with_suffix(".py"), root / path / "__init__.py"):
                if found.is_file() and needs(found, removed, seen):
                    return True
    return False


def test_needs(path: Path, removed: set[str]) -> bool:
    """Return whether a test module, or a `conftest.py` above it, imports a removed extension."""
    above = [folder / "conftest.py" for folder in path.parents if folder.is_relative_to(REPOSITORY / "tests")]
    return any(needs(file, removed, set()) for file in (path, *above) if file.is_file())


def check(name: str) -> bool:
    """Remove an extension, or all of them, and run the quick tests; return whether they pass."""
    removed = removed_with(name)
    others = [path for path in (REPOSITORY / "tests").rglob("test_*.py") if "extensions" not in path.parts]
    ignored = sorted(str(path.relative_to(REPOSITORY)) for path in others if test_needs(path, removed))
    with tempfile.TemporaryDirectory(prefix="sonarpost-without-") as folder:
        copy = Path(folder) / "copy"
        listed = subprocess.run(
            ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
            cwd=REPOSITORY, check=True, capture_output=True, text=True,
        ).stdout  # fmt: skip
        for file in filter(None, listed.split("\0")):
            source = REPOSITORY / file
            if source.is_file() or source.is_symlink():
                (copy / file).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(source, copy / file, follow_symlinks=False)
        for each in removed:
            shutil.rmtree(copy / "common" / "sonarpost" / "extensions" / each)
            shutil.rmtree(copy / "tests" / "extensions" / each, ignore_errors=True)
        command = [sys.executable, "-m", "pytest", "-q", "--numprocesses", "3", "--dist", "loadfile"]
        command += ["--no-loadscope-reorder", *(f"--ignore={file}" for file in ignored)]
        environment = {**os.environ, "PYTHONPATH": f"{copy / 'common'}{os.pathsep}{copy}"}
        done = subprocess.run(command, cwd=copy, env=environment, check=False, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    print(f"without {', '.join(sorted(removed))}: {lines[-1] if lines else done.stderr}", end="")
    print(f"; {len(ignored)} test files of the rest need it", flush=True)
    if done.returncode:
        print("\n".join(line for line in lines if line.startswith(("FAILED", "ERROR"))), flush=True)
    return done.returncode == 0


def main(chosen: list[str]) -> int:
    """Check the chosen extensions; return 0 if all quick tests pass."""
    passed = [check(name) for name in chosen or [*names(), "all"]]
    return 0 if all(passed) else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
