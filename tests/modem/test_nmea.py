import tracemalloc

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sonarpost.errors import SentenceError
from sonarpost.modem.micromodem import nmea
from sonarpost.modem.micromodem.nmea import MAX_SENTENCE_BYTES, LineAssembler, Sentence


def _split(body: str) -> Sentence:
    kind, *parts = body.split(",")
    return Sentence(kind, tuple(parts))


# Recorded between modems and third-party clients.
GOLDEN = {
    b"$CAREV,181807,AUV,2.0.27087*12": Sentence("CAREV", ("181807", "AUV", "2.0.27087")),
    b"$CAREV,000052,AUV,0.93.0.09*07": Sentence("CAREV", ("000052", "AUV", "0.93.0.09")),
    b"$CCCFG,CST,1*37": Sentence("CCCFG", ("CST", "1")),
    b"$CACFG,SRC,1*33": Sentence("CACFG", ("SRC", "1")),
    b"$CCCFQ,SRC*3A": Sentence("CCCFQ", ("SRC",)),
    b"$CATMQ,2019-12-02T03:02:59Z,RTC,RTC*6E": Sentence("CATMQ", ("2019-12-02T03:02:59Z", "RTC", "RTC")),
    b"$CCTXD,2,1,1,*7A": Sentence("CCTXD", ("2", "1", "1", "")),
    b"$CATXF,28*6E": Sentence("CATXF", ("28",)),
    b"$CACST,8,0,20250606230123.348554,06,32767,45,0102,0123,07,00,00,00,00,1,001,000,0,5,1,0,150,26.0,9.48,-100,"
    b"-6.48,-01,0.01,51,25000,5000,0,-1,-1,00*4A": _split(
        "CACST,8,0,20250606230123.348554,06,32767,45,0102,0123,07,00,00,00,00,1,001,000,0,5,1,0,150,26.0,9.48,-100,"
        "-6.48,-01,0.01,51,25000,5000,0,-1,-1,00"
    ),
    b"$CAXST,7,20250606,230117.336548,3,0,200,5000,25000,1,0,0,0,0,8,5,28,25000*66": _split(
        "CAXST,7,20250606,230117.336548,3,0,200,5000,25000,1,0,0,0,0,8,5,28,25000"
    ),
}
STREAM = b"".join(line + b"\r\n" for line in GOLDEN)
SENTENCES = list(GOLDEN.values())

kinds = st.from_regex(r"[A-Z][A-Z0-9]{2,11}", fullmatch=True)
fields = st.text(st.characters(min_codepoint=0x20, max_codepoint=0x7E, exclude_characters="$*,"), max_size=20)
sentences = st.builds(Sentence, kinds, st.lists(fields, max_size=8).map(tuple))


@pytest.mark.parametrize("line", GOLDEN)
def test_golden_sentences_parse_and_format(line: bytes) -> None:
    assert nmea.parse(line) == nmea.parse(line + b"\r\n") == GOLDEN[line]
    assert GOLDEN[line].encode() == line + b"\r\n"


@pytest.mark.parametrize(
    ("before", "after", "errors"),
    [
        (b"\x00\x00\x00", b"\x00", 0),
        (b"\r\n\n\r", b"  ", 0),
        (b"boot> ", b"half of $CAREV,1818", 2),
        (b"\xff\xfe\x80\r\n", b"\xff" * 300, 1),
        (b"$CATXP,28*6", b"$", 1),
        (b"!AIVDM,1*00\n", b"", 1),
    ],
)
def test_noise_around_sentences_loses_no_sentence(before: bytes, after: bytes, errors: int) -> None:
    items = LineAssembler("port A").feed(before + STREAM + after)
    assert [item for item in items if isinstance(item, Sentence)] == SENTENCES
    rejected = [item for item in items if isinstance(item, SentenceError)]
    assert len(rejected) == errors
    assert all(error.where == "port A" for error in rejected)


def test_only_the_truncated_line_is_rejected() -> None:
    error, sentence = LineAssembler().feed(b"$CARXD,1,2,0,1,AB$CATXF,28*6E\r\n")
    assert isinstance(error, SentenceError)
    assert (error.field, sentence) == ("checksum", Sentence("CATXF", ("28",)))


def test_line_without_line_end_is_accepted_with_checksum() -> None:
    assert LineAssembler().feed(STREAM.replace(b"\r\n", b"") + b"\n") == SENTENCES


def test_checksum_is_required_after_the_first_one_until_reset() -> None:
    lines = LineAssembler(learn_checksums=True)
    assert lines.feed(b"$CATXF,28\r\n$CATXF,28*6E\r\n") == [Sentence("CATXF", ("28",))] * 2
    assert isinstance(lines.feed(b"$CATXF,28\r\n")[0], SentenceError)
    lines.reset()
    assert lines.feed(b"$CATXF,28\r\n") == [Sentence("CATXF", ("28",))]


def test_missing_lower_case_and_wrong_checksum() -> None:
    assert nmea.parse(b"$CATXF,28") == nmea.parse(b"$CATXF,28*6e") == nmea.parse(b"$CATXF,28*6E")
    assert nmea.format("CATXF", 28) == b"$CATXF,28*6E\r\n"
    for wrong in (b"*6F", b"*6", b"*", b"*6E0", b"*G0", b"* 6E", b"*6E*6E"):
        with pytest.raises(SentenceError):
            nmea.parse(b"$CATXF,28" + wrong)
    with pytest.raises(SentenceError, match="checksum: got '6F', expected 6E for 'CATXF,28'"):
        nmea.parse(b"$CATXF,28*6F")


@pytest.mark.parametrize("position", range(1, 33))
def test_any_flipped_bit_is_detected(position: int) -> None:
    line = bytearray(b"$CAREV,181807,AUV,2.0.27087*12")
    line[position % len(line)] ^= 1 << (position % 7)
    lines = LineAssembler(learn_checksums=True)
    lines.feed(STREAM)
    damaged = lines.feed(bytes(line) + b"\r\n")
    assert Sentence("CAREV", ("181807", "AUV", "2.0.27087")) not in damaged
    assert all(isinstance(item, SentenceError) for item in damaged)


@pytest.mark.parametrize(
    "line", [b"", b"$", b"$*00", b"CATXF,28*6E", b"$caTXF,28", b"$C\x00TXF,28", b"$CA,1", b"$CATXF,\xe9", b"$\r\n"]
)
def test_invalid_line_is_rejected(line: bytes) -> None:
    with pytest.raises(SentenceError):
        nmea.parse(line)


@pytest.mark.parametrize("kind", ["", "ccCYC", "CC,YC"])
def test_format_rejects_kinds_that_cannot_be_parsed(kind: str) -> None:
    with pytest.raises(SentenceError):
        nmea.format(kind, "1")


@pytest.mark.parametrize(
    "field", ["a,b", "a*b", "a$b", "é", "1\r\n$CCMSC,1,1,0", "\x00", pytest.param("A" * MAX_SENTENCE_BYTES, id="long")]
)
def test_format_rejects_fields_that_cannot_be_parsed(field: str) -> None:
    with pytest.raises(SentenceError):
        nmea.format("CCCFG", field)


def test_longest_sentence_has_exactly_the_maximum_length() -> None:
    line = nmea.format("CCTXD", "A" * (MAX_SENTENCE_BYTES - len("$CCTXD,*00")))
    assert len(line.rstrip()) == MAX_SENTENCE_BYTES
    assert isinstance(LineAssembler().feed(line)[0], Sentence)
    assert isinstance(LineAssembler().feed(line.replace(b"AA", b"AAA", 1))[0], SentenceError)


def test_endless_line_uses_bounded_memory_and_ends_at_the_next_sentence() -> None:
    for start in (b"$CARXD,", b"\xffnoise"):
        lines = LineAssembler()
        tracemalloc.start()
        assert lines.feed(start) == []
        for _ in range(200):
            assert lines.feed(b"A" * 10_000) == []
            assert lines.pending_bytes <= MAX_SENTENCE_BYTES
        peak_bytes = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak_bytes < 200_000
        error, sentence = lines.feed(b"$CATXF,28*6E\r\n")
        assert isinstance(error, SentenceError)
        assert "2000007" in str(error) if start.startswith(b"$") else "2000006" in str(error)
        assert sentence == Sentence("CATXF", ("28",))


def test_reset_drops_an_unfinished_line() -> None:
    lines = LineAssembler()
    lines.feed(b"$CATXF,2")
    lines.reset()
    assert lines.feed(b"$CATXF,28*6E\r\n") == [Sentence("CATXF", ("28",))]


@given(st.lists(st.binary(max_size=200) | st.sampled_from(list(GOLDEN)), max_size=20))
@example([b"$", b"*", b"\r"])
def test_result_is_independent_of_the_read_boundaries(pieces: list[bytes]) -> None:
    lines = LineAssembler()
    items = [item for piece in pieces for item in lines.feed(piece)]
    assert all(isinstance(item, (Sentence, SentenceError)) for item in items)
    whole = LineAssembler().feed(b"".join(pieces))
    assert [str(item) for item in whole] == [str(item) for item in items], "the read boundaries have no effect"
    assert lines.pending_bytes <= MAX_SENTENCE_BYTES


@given(sentences)
def test_formatted_sentence_parses_back(sentence: Sentence) -> None:
    assert nmea.parse(sentence.encode()) == sentence
    assert LineAssembler().feed(sentence.encode()) == [sentence]
