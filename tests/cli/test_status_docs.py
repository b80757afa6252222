"""docs/explanation/operations.md, the alert rules and the dashboard agree with the code."""

from __future__ import annotations

import json
import re

from builders.common import REPOSITORY
from builders.fleet import FLEET, on_terminal

from sonarpost.monitoring.metrics import FleetCollector

DOCS = REPOSITORY / "docs" / "explanation"
PAGE = (DOCS / "operations.md").read_text(encoding="utf-8")


def test_documented_table_equals_the_output() -> None:
    (documented,) = re.findall(r"```text\n(tcp/.*?)```", PAGE, re.DOTALL)
    assert documented.splitlines() == on_terminal(FLEET)


def test_all_fixed_metrics_are_documented() -> None:
    named = {
        family.name + ("_total" if family.type == "counter" else "")
        for family in FleetCollector(lambda: FLEET).collect()
        if not any(sample.labels.get("service") for sample in family.samples)
        or family.name in ("sonarpost_up", "sonarpost_state", "sonarpost_health_age_seconds")
    }
    assert named
    assert {name for name in named if f"`{name}`" not in PAGE} == set()


def test_alert_rules_and_dashboard_use_published_metrics() -> None:
    pages = "".join(path.read_text(encoding="utf-8") for path in (REPOSITORY / "services").glob("*/README.md"))
    published = set(re.findall(r"`(\w+)`", pages))
    fixed = set(re.findall(r"`(sonarpost_\w+)`", PAGE))
    rules = (DOCS / "operations" / "alerts.yml").read_text(encoding="utf-8")
    dashboard = json.loads((DOCS / "operations" / "dashboard.json").read_text(encoding="utf-8"))
    used = set(re.findall(r"\bsonarpost_\w+", rules))
    for panel in dashboard["panels"]:
        used |= {name for target in panel["targets"] for name in re.findall(r"\bsonarpost_\w+", target["expr"])}
    assert len(used) > 10
    unknown = {n for n in used - fixed if n.removeprefix("sonarpost_").removesuffix("_total") not in published}
    assert unknown == set()
