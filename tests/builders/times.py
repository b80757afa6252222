"""Measures every test and fixture: `pytest --times FILE` writes JSON, `python tests/builders/times.py FILE` prints it.

The file holds one entry a test, `{"test", "set_up_s", "call_s", "tear_down_s", "cpu_s", "outcome"}`, and one a fixture,
`{"fixture", "count", "seconds"}`. Processor time includes the child processes that ended in the test.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections import defaultdict
from collections.abc import Generator, Iterable
from pathlib import Path
from typing import Any

import pytest

PHASES = {"setup": "set_up_s", "call": "call_s", "teardown": "tear_down_s"}
LISTED = 10
"""Entries of each list that is printed."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--times", metavar="FILE", help="write the time of every test and fixture to a JSON file")


def pytest_configure(config: pytest.Config) -> None:
    file = config.getoption("--times")
    if file:
        config.pluginmanager.register(Times(Path(file)))


def _cpu_s() -> float:
    usages = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


class Times:
    """Collects the times; a worker sends those of its fixtures with the report of the test."""

    def __init__(self, file: Path) -> None:
        self._file = file
        self._tests: dict[str, dict[str, Any]] = {}
        self._fixtures: dict[str, list[float]] = defaultdict(lambda: [0, 0.0])
        self._started_cpu_s = _cpu_s()

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(
        self, fixturedef: pytest.FixtureDef[Any], request: pytest.FixtureRequest
    ) -> Generator[None, Any, Any]:
        started_s = time.perf_counter()
        try:
            return (yield)
        finally:
            name = f"{fixturedef.baseid}::{fixturedef.argname}"
            request._pyfuncitem.user_properties.append(("fixture", [name, time.perf_counter() - started_s]))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, object, object]:
        item.stash[_STARTED_CPU] = _cpu_s()
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, Any]:
        report = yield
        if call.when == "teardown":
            report.user_properties.append(("cpu_s", _cpu_s() - item.stash[_STARTED_CPU]))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        test = self._tests.setdefault(
            report.nodeid, {"test": report.nodeid, "outcome": "passed", **dict.fromkeys(PHASES.values(), 0.0)}
        )
        test[PHASES[report.when or "call"]] = round(report.duration, 4)
        if report.outcome != "passed":
            test["outcome"] = report.outcome
        if report.when == "teardown":
            for name, value in report.user_properties:
                if name == "cpu_s":
                    test["cpu_s"] = round(float(str(value)), 4)
                elif name == "fixture" and isinstance(value, (list, tuple)):
                    self._fixtures[value[0]][0] += 1
                    self._fixtures[value[0]][1] += value[1]

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if hasattr(session.config, "workerinput"):
            return
        fixtures = [{"fixture": k, "count": n, "seconds": round(s, 4)} for k, (n, s) in self._fixtures.items()]
        self._file.parent.mkdir(parents=True, exist_ok=True)
        self._file.write_text(json.dumps({"tests": list(self._tests.values()), "fixtures": fixtures}, indent=0))


_STARTED_CPU = pytest.StashKey[float]()


def _total_s(test: dict[str, Any]) -> float:
    return float(sum(test[name] for name in PHASES.values()))


def _print_slowest(title: str, rows: Iterable[tuple[float, str]]) -> None:
    print(title)
    for seconds, name in sorted(rows, reverse=True)[:LISTED]:
        print(f"  {seconds:8.2f} s  {name}")


def main(file: str) -> None:
    """Print the sums, the slowest tests, fixtures and files, and how many tests take half of the time."""
    times = json.loads(Path(file).read_text())
    tests = times["tests"]
    total_s = sum(map(_total_s, tests))
    outcomes: dict[str, int] = defaultdict(int)
    by_file: dict[str, float] = defaultdict(float)
    by_folder: dict[str, float] = defaultdict(float)
    for test in tests:
        outcomes[test["outcome"]] += 1
        by_file[test["test"].partition("::")[0]] += _total_s(test)
        by_folder["/".join(test["test"].split("/")[1:3])] += _total_s(test)
    print(", ".join(f"{count} {outcome}" for outcome, count in sorted(outcomes.items())))
    print(f"{total_s:.0f} s in all workers, {sum(test.get('cpu_s', 0.0) for test in tests):.0f} s of processor time")
    half_s, count = 0.0, 0
    for test in sorted(tests, key=_total_s, reverse=True):
        if half_s >= total_s / 2:
            break
        half_s, count = half_s + _total_s(test), count + 1
    print(f"{count} tests take half of the time")
    _print_slowest("slowest tests", ((_total_s(test), test["test"]) for test in tests))
    _print_slowest("slowest fixtures", ((f["seconds"], f"{f['fixture']} ({f['count']})") for f in times["fixtures"]))
    _print_slowest("slowest files", ((seconds, name) for name, seconds in by_file.items()))
    _print_slowest("slowest folders", ((seconds, name) for name, seconds in by_folder.items()))


if __name__ == "__main__":
    main(sys.argv[1])
