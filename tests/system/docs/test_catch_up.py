"""The examples about queries: in docs/specifications/zenoh.md and docs/how-to/catch-up.md."""

from __future__ import annotations

import json
import queue
import re
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import zenoh
from builders.common import REPOSITORY, eventually
from builders.exports import image
from builders.record_samples import SAMPLES

from sonarpost import keys, wire
from sonarpost.archive.journal import Accepted, Journal
from sonarpost.bus import catch_up
from sonarpost.bus.session import client_config
from sonarpost.config import PlatformConfig
from sonarpost.errors import BadInputError
from sonarpost.services.c2 import queries, query_parameters
from sonarpost.services.c2.accepted import accepted_fields
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.json_form import json_payload
from sonarpost.services.c2.query_parameters import parse_parameters
from sonarpost.services.c2.service import C2Service

SPECIFICATION = (REPOSITORY / "docs" / "specifications" / "zenoh.md").read_text(encoding="utf-8")
HOW_TO = (REPOSITORY / "docs" / "how-to" / "catch-up.md").read_text(encoding="utf-8")
README = (REPOSITORY / "services" / "c2" / "README.md").read_text(encoding="utf-8")
PROGRAMS = [
    REPOSITORY / "examples" / "catch_up.py",
    REPOSITORY / "examples" / "rust" / "src" / "bin" / "catch_up.rs",
    REPOSITORY / "examples" / "javascript" / "catch_up.mjs",
]


def block(text: str, title: str) -> str:
    found = re.search(rf'^```\w+ title="{title}"\n(.*?)^```$', text, re.MULTILINE | re.DOTALL)
    assert found is not None
    return found[1]


SELECTORS = [
    *block(SPECIFICATION, "selectors").splitlines(),
    *re.findall(r"`(sonarpost/v1/shore/[^`]*\?[^`]*)`", HOW_TO),
    *re.findall(r"get -s '([^']*)'", HOW_TO),
]


def test_limits_are_those_of_the_documentation() -> None:
    assert (query_parameters.MAX_RECORDS, catch_up.MAX_RECORDS) == (256, 256)
    assert f"A page has at most {queries.MAX_BYTES} bytes" in SPECIFICATION
    assert queries.MAX_BYTES == 256 * 1024
    assert f"at most {query_parameters.MAX_LENGTH} characters" in SPECIFICATION
    assert f"{queries.MAX_IN_PROGRESS} queries are in progress" in SPECIFICATION
    assert f"{queries.RATE_PER_S:g} queries a second are exceeded ({queries.BURST:g} at once)" in SPECIFICATION
    assert f"{queries.MAX_IN_PROGRESS}, answered by {queries.THREADS} threads" in README
    for name in query_parameters.NAMES:
        assert f"\n| `{name}` | " in SPECIFICATION


def test_example_of_an_error() -> None:
    with pytest.raises(BadInputError) as caught:
        parse_parameters("limit=0", "sonarpost/v1/shore/contact/*/*", 0.0)
    assert f"{caught.value}\n" == block(SPECIFICATION, "query error")


def test_json_examples_equal_the_encoded_records() -> None:
    accepted = Accepted("3f9a1c2b", 1, 1_760_000_000.0)
    fields = wire.unpack_map(wire.encode(SAMPLES["decision-plain"]), "k")
    decision = json.loads(block(SPECIFICATION, "decision in JSON"))
    assert decision == json.loads(json_payload(accepted_fields(fields, accepted), "raw"))
    page = queries.Page(records=1, unreadable=0, more=False, next="3f9a1c2b.1")
    assert json.loads(block(SPECIFICATION, "page in JSON")) == page.fields()


@pytest.fixture
def c2(platform: Callable[[str], PlatformConfig], tmp_path: Path) -> Iterator[C2Service]:
    service = C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out"))
    assert service.start()
    yield service
    service.stop()


def test_selectors_are_valid_and_zenoh_parses_them(c2: C2Service, client: zenoh.Session) -> None:
    assert len(SELECTORS) > 9
    querier = client.declare_querier(keys.shore_contact_all())
    eventually(lambda: querier.matching_status.matching, what="queryable")
    for selector in SELECTORS:
        replies = list(client.get(zenoh.Selector(*selector.partition("?")[::2]), timeout=60))
        assert [reply.err and reply.err.payload.to_string() for reply in replies] == [None], selector


def test_program_of_the_how_to(c2: C2Service, router: str, tmp_path: Path) -> None:
    accept = c2._accepted
    accept.number([accept.image(image(f"{n:04X}"), "") for n in range(1, 4)])
    path = tmp_path / "catch_up.py"
    path.write_text(block(HOW_TO, "catch_up"), encoding="utf-8")
    command = [sys.executable, str(path), router]
    lines: queue.Queue[str] = queue.Queue()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        assert process.stdout is not None
        reader = threading.Thread(target=lambda: [lines.put(line.strip()) for line in process.stdout or ()])
        reader.start()
        found = [lines.get(timeout=120) for _ in range(3)]
        saved = tmp_path / "cursor.txt"
        try:
            eventually(lambda: saved.is_file() and re.fullmatch(r"[0-9a-f]{8}\.[0-9]+", saved.read_text()) is not None)
        finally:
            process.kill()
            reader.join()
    assert found == [f"{n} uuv-1 {n:04X} 1" for n in range(1, 4)]


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: path.suffix)
def test_programs_repeat_the_query_as_specified(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert re.search(r"30(000)?\b", text)
    assert ": busy: " in text
    assert "Repeat 2 every 30 s" in SPECIFICATION


def test_sessions_and_journal_of_the_documentation_exist(tmp_path: Path) -> None:
    qos = json.loads(client_config(["tcp/127.0.0.1:1"]).get_json("qos/network"))
    assert [rule["overwrite"]["congestion_control"] for rule in qos] == ["drop"]
    journal = Journal(tmp_path)
    assert journal.path.name == "journal.db"
    journal.close()
