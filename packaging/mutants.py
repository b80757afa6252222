"""Make faults in random product functions and count those that the tests catch: packaging/mutants.py --seed 32.

Each fault is a negated condition, an integer or a comparison off by one, or a dropped call. It is made in a copy of the
checkout. There, the quick tests that execute the function run; a run with coverage says which these are:

    make test ARGS="--cov common/sonarpost --cov services --cov-context test --cov-report="

A fault that they do not catch is printed; `--keep NUMBER` leaves it in the copy, for a run of other tests.
"""

import argparse
import ast
import os
import random
import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent
COPY = ROOT / "build" / "mutants"
ENVIRONMENT = os.environ | {"PYTHONPATH": str(COPY / "common")}
MAX_TESTS = 200
OFF_BY_ONE = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">"}


@dataclass(frozen=True)
class Fault:
    """A replacement in one file, in a function whose lines are `first` to `last`."""

    file: Path
    function: str
    first: int
    last: int
    start: tuple[int, int]
    end: tuple[int, int]
    replacement: str

    def apply(self, text: str) -> str:
        """Return the changed source; positions are in bytes of UTF-8, as `ast` counts them."""
        lines = text.encode().splitlines(keepends=True)
        head = b"".join(lines[: self.start[0] - 1]) + lines[self.start[0] - 1][: self.start[1]]
        tail = lines[self.end[0] - 1][self.end[1] :] + b"".join(lines[self.end[0] :])
        return (head + self.replacement.encode() + tail).decode()


def sites(function: ast.AST, text: str) -> Iterator[tuple[str, ast.AST, str]]:
    """Yield kind, node and replacement of each possible fault of a function."""
    for node in ast.walk(function):
        if isinstance(node, ast.If | ast.While | ast.IfExp):
            yield "negated condition", node.test, f"not ({ast.get_source_segment(text, node.test)})"
        elif isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in OFF_BY_ONE:
            left, right = (ast.get_source_segment(text, part) for part in (node.left, node.comparators[0]))
            yield "off by one", node, f"{left} {OFF_BY_ONE[type(node.ops[0])]} {right}"
        elif isinstance(node, ast.BinOp | ast.Subscript):
            parts = (node.left, node.right) if isinstance(node, ast.BinOp) else ast.walk(node.slice)
            for part in parts:
                if isinstance(part, ast.Constant) and type(part.value) is int:
                    yield "off by one", part, str(part.value + 1)
        elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
            yield "dropped call", node, "None"


def faults(seed: int, count: int) -> list[Fault]:
    """Return one fault in each of `count` random functions of the product."""
    chance = random.Random(seed)  # noqa: S311 a repeatable choice
    found: list[tuple[Path, ast.FunctionDef, str]] = []
    for folder in ("common/sonarpost", "services"):
        for file in sorted((ROOT / folder).rglob("*.py")):
            if "services" in file.relative_to(ROOT / folder).parts[:1]:
                continue  # the symbolic link
            text = file.read_text(encoding="utf-8")
            functions = (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.FunctionDef))
            found += [(file.relative_to(ROOT), node, text) for node in functions if any(sites(node, text))]
    chosen = []
    for file, function, text in chance.sample(found, count):
        possible = list(sites(function, text))
        kind = chance.choice(sorted({kind for kind, *_ in possible}))
        _, node, replacement = chance.choice([site for site in possible if site[0] == kind])
        start, end = (node.lineno, node.col_offset), (node.end_lineno, node.end_col_offset)  # type: ignore[attr-defined]
        body = function.body[0].lineno
        chosen.append(Fault(file, function.name, body, function.end_lineno or body, start, end, replacement))
    return chosen


def tests_of(fault: Fault, coverage: Path) -> list[str]:
    """Return the tests that execute the function; where none is known, as in compiled code, those of its package."""
    with sqlite3.connect(coverage) as database:
        rows = database.execute(
            "SELECT context, numbits FROM line_bits JOIN context ON context.id = context_id"
            " JOIN file ON file.id = file_id WHERE path LIKE ?",
            (f"%/{fault.file}",),
        ).fetchall()
    lines = range(fault.first, fault.last + 1)
    found = {
        context.partition("|")[0].partition("[")[0]
        for context, bits in rows
        if any(line // 8 < len(bits) and bits[line // 8] >> line % 8 & 1 for line in lines)
    }
    folder = Path("tests", *fault.file.parts[2 if fault.file.parts[0] == "common" else 0 : -1])
    return sorted(found - {""}) or [str(folder)] * (ROOT / folder).is_dir()


def is_caught(tests: list[str], seed: int) -> bool:
    """Run the tests in the copy; return whether one fails or hangs."""
    chosen = sorted(random.Random(seed).sample(tests, min(MAX_TESTS, len(tests))))  # noqa: S311
    options = "-x -q -n2 -p no:cacheprovider --timeout 60"
    command = [sys.executable, "-m", "pytest", *options.split()]
    done = subprocess.run([*command, *chosen], cwd=COPY, env=ENVIRONMENT, check=False, capture_output=True, text=True)  # noqa: S603
    if done.returncode not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED, pytest.ExitCode.INTERRUPTED):
        sys.exit(f"{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode != pytest.ExitCode.OK


def main() -> None:
    """Print a line for each fault, and the number that was caught."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--seed", type=int, default=32)
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--coverage", type=Path, default=ROOT / ".coverage")
    parser.add_argument("--first", type=int, default=0, help="number of the first fault to make")
    parser.add_argument("--keep", type=int, help="make only this fault in the copy, and run nothing")
    options = parser.parse_args()
    shutil.rmtree(COPY, ignore_errors=True)
    subprocess.run(["git", "clone", "-q", str(ROOT), str(COPY)], check=True)  # noqa: S603, S607
    (COPY / ".venv").symlink_to(ROOT / ".venv")
    subprocess.run([BIN / "sonarpost", "prepare"], cwd=COPY, env=ENVIRONMENT, check=True)  # noqa: S603
    caught = 0
    for number, fault in enumerate(faults(options.seed, options.count)):
        if number < options.first or options.keep not in (None, number):
            continue
        path = COPY / fault.file
        original = path.read_text(encoding="utf-8")
        path.write_text(fault.apply(original), encoding="utf-8")
        ast.parse(path.read_text(encoding="utf-8"))
        if options.keep is not None:
            return
        tests = tests_of(fault, options.coverage)
        result = bool(tests) and is_caught(tests, options.seed)
        path.write_text(original, encoding="utf-8")
        caught += result
        verdict = "caught" if result else "NOT CAUGHT"
        place = f"{fault.file}:{fault.start[0]} {fault.function}"
        print(f"{number:2} {verdict:10} {place}: {fault.replacement!r}, {len(tests)} tests", flush=True)
    print(f"{caught} of {options.count - options.first} caught by the quick tests")


if __name__ == "__main__":
    main()
