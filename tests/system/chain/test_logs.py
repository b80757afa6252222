"""One contact followed through the logs of all services, as in docs/explanation/operations.md."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from builders.chain import RunningChain

pytestmark = pytest.mark.chain

# Log line of each service for one contact; the first two have `contact_id`, the others `image_id`.
STEPS = {
    "atd_stub": "Contact detected",
    "compressor": "Image encoded",
    "uuv_modem": "Image sent",
    "op_modem": "Image received",
    "decompressor": "Image decoded",
    "relay": "Image queued for the shore",
    "c2": "Image stored",
}

Line = dict[str, str]


def read_json(text: str) -> list[Line]:
    return [{name: str(value) for name, value in json.loads(line).items()} for line in text.splitlines()]


def read_text(text: str) -> list[Line]:
    lines: list[Line] = []
    for line in text.splitlines():
        _, _, service, rest = line.split(" ", 3)
        fields = dict(re.findall(r'(\w+)=("(?:[^"\\]|\\.)*"|\S+)', rest))
        lines.append({"service": service.rstrip(":"), "message": re.split(r" \w+=", rest)[0], **fields})
    return lines


def steps_with(lines: list[Line], **wanted: str) -> set[str]:
    """Return the services that logged their line of `STEPS` with these fields."""
    return {
        line["service"]
        for line in lines
        if STEPS.get(line["service"]) == line["message"] and wanted.items() <= line.items()
    }


@pytest.mark.parametrize(("log_format", "read"), [("json", read_json), ("text", read_text)])
def test_one_contact_is_followed_from_detection_to_the_shore(
    start_chain: Callable[..., RunningChain],
    monkeypatch: pytest.MonkeyPatch,
    log_format: str,
    read: Callable[[str], list[Line]],
) -> None:
    monkeypatch.setenv("SONARPOST_PLATFORM__LOG_FORMAT", log_format)
    run = start_chain()
    run.deposit(2)
    run.until(lambda: len(run.watcher.shore) == 2, 60, "both images at the shore site")
    folder: Path = run.settings.folder / "logs"
    lines = [line for service in STEPS for line in read((folder / f"{service}.log").read_text())]
    identifiers: set[str] = set()
    for contact_id in run.watcher.snippets:
        assert steps_with(lines, contact_id=contact_id) == {"atd_stub", "compressor", "uuv_modem"}
        (join,) = (n for n in lines if n["message"] == STEPS["compressor"] and n["contact_id"] == contact_id)
        vehicle, image_id = join["vehicle"], join["image_id"]
        assert steps_with(lines, image_id=image_id) == set(STEPS) - {"atd_stub"}
        assert steps_with(lines, vehicle=vehicle, image_id=image_id) == set(STEPS) - {"atd_stub"}
        identifiers.add(image_id)
    assert len(identifiers) == 2
