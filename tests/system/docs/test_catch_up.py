"""The examples about queries: in docs/specifications/queries.md and docs/how-to/catch-up.md."""

import json
import re
import sys

import pytest
import zenoh
from builders.common import REPOSITORY, WAIT_S, eventually, running
from builders.exports import image
from builders.line_program import run_program
from builders.record_samples import SAMPLES
from builders.shore import number_images

from sonarpost import keys, wire
from sonarpost.archive.journal import Accepted
from sonarpost.errors import BadInputError
from sonarpost.services.c2 import queries
from sonarpost.services.c2.accepted import accepted_fields
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.json_form import json_payload
from sonarpost.services.c2.query_parameters import parse_parameters
from sonarpost.services.c2.service import C2Service

__all__ = ["run_program"]

SPECIFICATION = (REPOSITORY / "docs" / "specifications" / "queries.md").read_text(encoding="utf-8")
HOW_TO = (REPOSITORY / "docs" / "how-to" / "catch-up.md").read_text(encoding="utf-8")


def block(text, title):
    found = re.search(rf'^```\w+ title="{title}"\n(.*?)^```$', text, re.MULTILINE | re.DOTALL)
    return found[1]


SELECTORS = [
    *block(SPECIFICATION, "selectors").splitlines(),
    *re.findall(r"`(sonarpost/v1/shore/[^`]*\?[^`]*)`", HOW_TO),
    *re.findall(r"get -s '([^']*)'", HOW_TO),
]


def test_example_of_an_error():
    with pytest.raises(BadInputError) as caught:
        parse_parameters("limit=0", "sonarpost/v1/shore/contact/*/*", 0.0)
    assert f"{caught.value}\n" == block(SPECIFICATION, "query error")


def test_json_examples_equal_the_encoded_records():
    accepted = Accepted("3f9a1c2b", 1, 1_760_000_000.0)
    fields = wire.unpack_map(wire.encode(SAMPLES["decision-bare"]), "k")
    decision = json.loads(block(SPECIFICATION, "decision in JSON"))
    assert decision == json.loads(json_payload(accepted_fields(fields, accepted), "raw"))
    page = queries.Page(records=1, unreadable=0, more=False, next="3f9a1c2b.1")
    assert json.loads(block(SPECIFICATION, "page in JSON")) == page.fields()


@pytest.fixture
def c2(platform, tmp_path):
    with running(C2Service(platform("shore-1"), C2Config(out_dir=tmp_path / "out"))) as service:
        yield service


def test_selectors_are_valid_and_zenoh_parses_them(c2, client):
    assert len(SELECTORS) > 9
    querier = client.declare_querier(keys.shore_contact_all())
    eventually(lambda: querier.matching_status.matching, what="queryable")
    for selector in SELECTORS:
        replies = list(client.get(zenoh.Selector(*selector.partition("?")[::2]), timeout=WAIT_S))
        assert [reply.err and reply.err.payload.to_string() for reply in replies] == [None], selector


def test_program_of_the_how_to(c2, router, tmp_path, run_program, monkeypatch):
    number_images(c2, [image(f"{n:04X}") for n in range(1, 4)])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "catch_up.py").write_text(block(HOW_TO, "catch_up"), encoding="utf-8")
    program = run_program(sys.executable, "catch_up.py", router)
    assert program.read(3) == [f"{n} uuv-1 {n:04X} 1" for n in range(1, 4)]
    saved = tmp_path / "cursor.txt"
    eventually(lambda: saved.is_file() and re.fullmatch(r"[0-9a-f]{8}\.[0-9]+", saved.read_text()) is not None)
