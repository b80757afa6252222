"""Documents of operation: commands that follow one contact, and the metrics of alert rules and dashboard."""

import json
import logging
import re
import shutil
import subprocess

import pytest
import reference
from builders.common import REPOSITORY

from sonarpost.logs import JsonFormatter, TextFormatter, kv

DOCS = REPOSITORY / "docs" / "explanation"


@pytest.mark.parametrize("log_format", ["json", "text"])
def test_documented_commands_find_the_lines_of_one_contact(log_format, tmp_path):
    if log_format == "json" and shutil.which("jq") is None:
        pytest.skip("jq is not installed")
    page = (DOCS / "operations.md").read_text(encoding="utf-8")
    section = page.split("## One contact through the chain")[1]
    with_json, with_text = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    contact = with_json.splitlines()[0].split("'")[1]
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


def test_alert_rules_and_dashboard_use_published_metrics():
    pages = "".join(path.read_text(encoding="utf-8") for path in REPOSITORY.glob("services/*/README.md"))
    pages += (DOCS / "operations.md").read_text(encoding="utf-8")
    published = set(re.findall(r"`(\w+)`", pages))
    fixed = set(re.findall(r"`(sonarpost_\w+)`", reference.metrics()))
    rules = (DOCS / "operations" / "alerts.yml").read_text(encoding="utf-8")
    dashboard = json.loads((DOCS / "operations" / "dashboard.json").read_text(encoding="utf-8"))
    used = set(re.findall(r"\bsonarpost_\w+", rules))
    for panel in dashboard["panels"]:
        used |= {name for target in panel["targets"] for name in re.findall(r"\bsonarpost_\w+", target["expr"])}
    assert len(used) > 10
    assert {n for n in used - fixed if n.removeprefix("sonarpost_").removesuffix("_total") not in published} == set()
