"""Locked dependencies: hashes, agreement of the lock files, software bill of materials, audit report."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
import tomllib
from types import ModuleType

import pytest
from builders.common import REPOSITORY

LOCKS = ("requirements.lock", "requirements-build.lock", "requirements-dev.lock")


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / "packaging" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


sbom, audit = script("sbom"), script("audit")


def read(lock: str) -> str:
    return (REPOSITORY / lock).read_text()


@pytest.mark.parametrize("lock", LOCKS)
def test_every_package_is_pinned_with_hashes(lock) -> None:
    # One requirement with its hashes is one logical line.
    text = re.sub(r"^ *#.*\n", "", read(lock), flags=re.MULTILINE).replace("\\\n", " ")
    lines = text.splitlines()
    assert len(lines) == len(sbom.locked(read(lock)))
    for line in lines:
        assert re.match(r"[\w.-]+==\S+ +(--hash=sha256:[0-9a-f]{64} *)+$", line), line


def test_the_lock_files_agree_and_hold_the_declared_dependencies() -> None:
    run_time, build, development = (sbom.locked(read(lock)) for lock in LOCKS)
    assert run_time | build <= development
    project = tomllib.loads(read("pyproject.toml"))
    extras = project["project"]["optional-dependencies"]
    for declared, packages in (
        (project["project"]["dependencies"], run_time),
        (extras["console"], run_time),
        (project["dependency-groups"]["build"], build),
        *((extras[extra], development) for extra in ("research", "dev", "docs")),
    ):
        names = {sbom.normalised(re.split(r"[\[<>=~]", name)[0]) for name in declared} - {"sonarpost"}
        assert names <= {name for name, _ in packages}
    # Tools of tests and checks are not installed with the product.
    assert not {"pytest", "hatchling", "pip-audit", "cyclonedx-bom"} & {name for name, _ in run_time}


def test_a_bill_of_materials_of_the_lock_file_has_its_packages(tmp_path) -> None:
    pytest.importorskip("cyclonedx_py", reason="cyclonedx-bom is not installed")
    path = tmp_path / "sbom.json"
    command = [
        sys.executable,
        "-m",
        "cyclonedx_py",
        "requirements",
        str(REPOSITORY / LOCKS[0]),
        "--output-file",
        str(path),
    ]
    subprocess.run(command, check=True, capture_output=True)
    assert sbom.listed(path.read_text()) == sbom.locked(read(LOCKS[0]))


def test_a_bill_of_materials_that_differs_is_reported() -> None:
    lock = sbom.locked("numpy==2.4.6 \\\n    --hash=sha256:aa\npydantic-core==2.50.4 \\\n    --hash=sha256:bb\n")
    components = [{"name": "numpy", "version": "2.4.5"}, {"name": "pydantic_core", "version": "2.50.4"}]
    assert sbom.differences(lock, sbom.listed(json.dumps({"components": components}))) == [
        "numpy 2.4.6: in the lock file only",
        "numpy 2.4.5: in the bill of materials only",
    ]


def test_the_audit_reports_vulnerable_packages_and_packages_without_data() -> None:
    vulnerability = {"id": "PYSEC-2026-1", "fix_versions": ["1.1"], "aliases": [], "description": ""}
    clean = {"name": "numpy", "version": "2.4.6", "vulns": []}
    vulnerable = {"name": "h11", "version": "1.0", "vulns": [vulnerability]}
    skipped = {"name": "rich", "skip_reason": "Dependency not found on PyPI"}
    assert audit.report([clean, vulnerable, skipped]) == (
        [
            "h11 1.0: PYSEC-2026-1, fixed in 1.1",
            "2 of 3 packages audited, 1 with known vulnerabilities",
            "NOT AUDITED, no data for: rich",
        ],
        True,
    )
    assert audit.report([clean])[1] is False


def test_an_unreachable_service_is_reported_and_is_no_finding(monkeypatch, capsys) -> None:
    pytest.importorskip("pip_audit", reason="pip-audit is not installed")
    monkeypatch.setenv("HTTPS_PROXY", "http://127.0.0.1:9")
    assert audit.audit(str(REPOSITORY / "requirements-build.lock")) is False
    assert "NOT AUDITED, the vulnerability service is not reached" in capsys.readouterr().out
