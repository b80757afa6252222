"""Locked dependencies: hashes, agreement of the lock files, software bill of materials, audit report."""

import importlib.util
import json
import re
import tomllib

import pytest
from builders.common import REPOSITORY

OTHERS = ("build", "test", "dev", "release")
LOCKS = {"run time": "requirements.lock", **{name: f"requirements-{name}.lock" for name in OTHERS}}


def script(name):
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / "packaging" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


sbom, audit = script("sbom"), script("audit")


def read(lock):
    return (REPOSITORY / lock).read_text()


@pytest.mark.parametrize("lock", LOCKS.values())
def test_every_package_is_pinned_with_hashes(lock):
    # One requirement with its hashes is one logical line.
    text = re.sub(r"^ *#.*\n", "", read(lock), flags=re.MULTILINE).replace("\\\n", " ")
    lines = text.splitlines()
    assert len(lines) == len(sbom.locked(read(lock)))
    for line in lines:
        assert re.match(r"[\w.-]+==\S+ +(--hash=sha256:[0-9a-f]{64} *)+$", line), line


def test_the_lock_files_agree_and_hold_the_declared_dependencies():
    locked = {name: sbom.locked(read(lock)) for name, lock in LOCKS.items()}
    assert locked["run time"] <= locked["test"] <= locked["dev"]
    versions = set().union(*(locked[name] for name in ("run time", "build", "test", "dev")))
    assert len(versions) == len(dict(versions)), "one version of each package"
    project = tomllib.loads(read("pyproject.toml"))
    extras, groups = project["project"]["optional-dependencies"], project["dependency-groups"]
    for declared, lock in (
        (project["project"]["dependencies"], "run time"),
        (extras["console"], "run time"),
        (groups["build"], "build"),
        (groups["release"], "release"),
        (extras["test"], "test"),
        *((extras[extra], "dev") for extra in ("research", "dev", "docs")),
    ):
        names = {sbom.normalised(re.split(r"[\[<>=~]", name)[0]) for name in declared} - {"sonarpost"}
        assert names <= {name for name, _ in locked[lock]}, lock
    # Tools of tests, checks and releases are not installed with the product or the tests.
    assert not {"pytest", "hatchling"} & {name for name, _ in locked["run time"]}
    assert not {"pip-audit", "cyclonedx-bom"} & {name for name, _ in locked["dev"]}


def test_a_bill_of_materials_that_differs_is_reported():
    lock = sbom.locked("numpy==2.4.6 \\\n    --hash=sha256:aa\npydantic-core==2.50.4 \\\n    --hash=sha256:bb\n")
    components = [{"name": "numpy", "version": "2.4.5"}, {"name": "pydantic_core", "version": "2.50.4"}]
    assert sbom.differences(lock, sbom.listed(json.dumps({"components": components}))) == [
        "numpy 2.4.6: in the lock file only",
        "numpy 2.4.5: in the bill of materials only",
    ]


def test_the_audit_reports_vulnerable_packages_and_packages_without_data():
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
