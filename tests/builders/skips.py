"""`pytest --no-skips`: a test that is skipped for a reason that is not listed here fails the run."""

import pytest

ALLOWED = (
    # Recordings and snippets of others lie beside the project.
    "no real survey data",
    "no recording under",
    "no images below",
    # A TAK server; it needs ports of its own.
    "no taky",
    # Compiling Zenoh for the Rust example takes longer than all quick tests.
    "examples/rust has not been built",
    # A sandbox may refuse to give up capabilities.
    "cannot start the interpreter without privileges",
    # Debian has no package of it.
    "kubectl is not installed",
)
"""Beginnings of the accepted reasons."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--no-skips", action="store_true", help="fail if a test is skipped for an unlisted reason")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--no-skips") and not hasattr(config, "workerinput"):
        config.pluginmanager.register(Skips())


class Skips:
    """Collects the unlisted skips of all workers."""

    def __init__(self) -> None:
        self._unlisted: list[str] = []

    def _collect(self, report: pytest.TestReport | pytest.CollectReport) -> None:
        if report.skipped and not hasattr(report, "wasxfail"):
            reason = report.longrepr[2].removeprefix("Skipped: ") if isinstance(report.longrepr, tuple) else ""
            if not reason.startswith(ALLOWED):
                self._unlisted.append(f"{report.nodeid}: {reason}")

    pytest_runtest_logreport = _collect
    pytest_collectreport = _collect

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if self._unlisted and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        for line in self._unlisted:
            terminalreporter.write_line(f"SKIPPED, not allowed with --no-skips: {line}", red=True)
