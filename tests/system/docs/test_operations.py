"""Documents of operation: the status example, metrics of alert rules and dashboard, counters of the services' pages."""

from __future__ import annotations

import ast
import json
import logging
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import reference
from builders.common import REPOSITORY
from builders.fleet import FLEET, on_terminal

from sonarpost.config import SERVICES, ServiceConfig
from sonarpost.logs import JsonFormatter, TextFormatter, kv
from sonarpost.runtime.modem_service import ModemServiceConfig
from sonarpost.runtime.service import Service

DOCS = REPOSITORY / "docs" / "explanation"
RUNTIME = REPOSITORY / "common" / "sonarpost" / "runtime"
BASE_GAUGES = {"inbox", "outbox", "refused", "disk_free_bytes"}
# Counters whose names are composed of a record's type.
COMPOSED_COUNTERS = {
    "c2": {"short_contacts_received", "short_decisions_received"},
    "relay": {"reconstructed_images_relayed", "decisions_relayed"},
}


def health_names(name: str) -> list[str]:
    """Return the counters and gauges of the tables below the heading Health of a service's page."""
    text = (REPOSITORY / "services" / name / "README.md").read_text(encoding="utf-8")
    [section] = [part for part in re.split(r"^## ", text, flags=re.MULTILINE) if part.startswith("Health\n")]
    cells = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    return [found for cell in cells for found in re.findall(r"`(\w+)`", cell)]


def counters_in_code(sources: list[str]) -> Iterator[str]:
    """Return the names given to `count`."""
    for source in sources:
        for node in ast.walk(ast.parse(source)):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Attribute)
                and node.func.attr in ("count", "_count")
            ):
                for part in ast.walk(node.args[0]) if node.args and not isinstance(node.args[0], ast.JoinedStr) else ():
                    if isinstance(part, ast.Constant) and re.fullmatch("[a-z_]+", str(part.value)):
                        yield str(part.value)


CONDITIONAL_GAUGES = {
    "atd_stub": {"expected_pd", "clutter_per_1000_m2", "ripple_strength", "worst_expected_pd"},
    "relay": {
        f"satellite_{name}_shore" for name in ("waiting", "unacknowledged", "bytes_today", "bytes", "messages", "cost")
    },
}
"""Gauges that a service has only after its first file, or with a satellite upstream."""


@pytest.mark.parametrize("name", [n for n in SERVICES if n != "acoustic_channel"])
def test_counters_and_gauges_of_a_service_are_in_its_page(name: str, service: Service[ServiceConfig]) -> None:
    sources = [p.read_text(encoding="utf-8") for p in (REPOSITORY / "services" / name).glob("*.py")]
    if isinstance(service.config, ModemServiceConfig):
        sources.append((RUNTIME / "modem_service.py").read_text(encoding="utf-8"))
    if service.consumed_keys():
        sources.append((RUNTIME / "service.py").read_text(encoding="utf-8"))
    names = set(counters_in_code(sources)) | COMPOSED_COUNTERS.get(name, set()) | set(service.gauges()) | BASE_GAUGES
    names |= CONDITIONAL_GAUGES.get(name, set())
    documented = health_names(name)
    assert len(documented) == len(set(documented))
    assert set(documented) == names


@pytest.mark.parametrize("log_format", ["json", "text"])
def test_trace_of_one_contact_finds_its_lines(log_format: str, tmp_path: Path) -> None:
    """The message of the documented commands is the compressor's, and they find the lines of one contact."""
    if log_format == "json" and shutil.which("jq") is None:
        pytest.skip("jq is not installed")
    page = (DOCS / "operations.md").read_text(encoding="utf-8")
    section = page.split("## One contact through the chain")[1]
    with_json, with_text = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    contact = with_json.splitlines()[0].split("'")[1]
    assert '"Image encoded"' in (REPOSITORY / "services" / "compressor" / "service.py").read_text(encoding="utf-8")
    formatter = {"json": JsonFormatter, "text": TextFormatter}[log_format]
    for service, message, fields in (
        ("compressor", "Image encoded", {"contact_id": contact, "image_id": "00A7"}),
        ("compressor", "Image encoded", {"contact_id": "another", "image_id": "00A8"}),
        ("relay", "Record queued", {"image_id": "00A7"}),
    ):
        record = logging.makeLogRecord({"msg": message, "levelname": "INFO", **kv(**fields)})
        path = tmp_path / "logs" / f"{service}.log"
        path.parent.mkdir(exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(formatter(service).format(record) + "\n")
    script = with_json if log_format == "json" else f"contact='{contact}'\n{with_text}"
    result = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert len(result.stdout.splitlines()) == 2
    assert "00A8" not in result.stdout


def test_documented_status_table_equals_the_output() -> None:
    page = (DOCS / "operations.md").read_text(encoding="utf-8")
    (documented,) = re.findall(r"```text\n(tcp/.*?)```", page, re.DOTALL)
    assert documented.splitlines() == on_terminal(FLEET)


def test_alert_rules_and_dashboard_use_published_metrics() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in REPOSITORY.glob("services/*/README.md"))
    published = set(re.findall(r"`(\w+)`", pages))
    fixed = set(re.findall(r"`(sonarpost_\w+)`", reference.metrics()))
    rules = (DOCS / "operations" / "alerts.yml").read_text(encoding="utf-8")
    dashboard = json.loads((DOCS / "operations" / "dashboard.json").read_text(encoding="utf-8"))
    used = set(re.findall(r"\bsonarpost_\w+", rules))
    for panel in dashboard["panels"]:
        used |= {name for target in panel["targets"] for name in re.findall(r"\bsonarpost_\w+", target["expr"])}
    assert len(used) > 10
    assert {n for n in used - fixed if n.removeprefix("sonarpost_").removesuffix("_total") not in published} == set()
