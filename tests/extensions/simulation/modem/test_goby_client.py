"""What Goby3's Micro-Modem driver sends, by its source, is answered with the sentence that it waits for.

The tests do not build Goby; docs/reference/modem-emulator.md says which program of it was run. Its driver sends one
command after the other: each waits for a sentence of the same kind, a setting for an echo of all its parts, a restart
for `CAREV`. Goby reads statistics of any version but 6 as of the first.
"""

import pytest
from builders.emulator_bench import EmulatorBench

from sonarpost.modem.micromodem import RATES

SETTINGS = (("CST", 1), ("AGC", 0), ("AGN", 0), ("SRC", 1), ("REV", 1), ("RXP", 1))


@pytest.fixture(params=[1, 2])
def bench(request: pytest.FixtureRequest) -> EmulatorBench:
    """Modems after Goby's start-up: settings of one generation, a restart, and the clock."""
    bench = EmulatorBench(generation=request.param)
    first, last = ([("ALL", 0)], []) if request.param == 1 else ([], [("psk.packet.mod_hdr_version", 0)])
    for name, value in (*first, *SETTINGS, *last):
        bench.send(1, ("CCCFG", name, value))
        assert bench.sentences(1) == [f"CACFG,{name},{value}"]
    bench.send(1, ("CCMSC", 1, 1, 0))
    bench.advance(15.0)
    assert b",INIT," in bench.output[1]
    assert b",AUV," in bench.output[1]
    bench.clear_output()
    clock, answer = {
        1: (("CCCLK", 2024, 2, 29, 23, 59, 60), "CACLK,2024,2,29,23,59,60"),
        2: (("CCTMS", "2024-03-01T00:00:00Z", 0), "CATMS,0,2024-03-01T00:00:00Z"),
    }[request.param]
    bench.send(1, clock)
    assert bench.sentences(1)[-1] == answer
    bench.clear_output()
    return bench


def kinds(bench: EmulatorBench, modem: int) -> list[str]:
    return [line.split(",")[0] for line in bench.sentences(modem)]


@pytest.mark.parametrize(
    ("command", "own", "other"),
    [
        (("CCCFQ", "SRC"), ["CACFG"], []),
        (("CCMPC", 1, 2), ["CAMPC", "CATXP", "CATXF", "CARXP", "CAMPR", "CACST"], ["CARXP", "CAMPA", "CACST"]),
        (("CCMUC", 1, 2, "0123"), ["CAMUC", "CATXP", "CATXF", "CARXP", "CAMUR"], ["CARXP", "CAMUA", "CACST"]),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_command_is_answered_with_the_sentence_goby_waits_for(bench: EmulatorBench, command, own, other):
    bench.send(1, command)
    bench.advance(bench.now + 10.0)
    assert kinds(bench, 1) == own
    assert kinds(bench, 2)[: len(other)] == other


@pytest.mark.parametrize("rate", [0, 2, 5])
def test_packet_has_one_result_an_acknowledgement_of_each_frame_and_statistics_of_version_6(bench, rate):
    count = RATES[rate].frames
    for _ in range(2):
        bench.send(1, ("CCCYC", 0, 1, 2, rate, 1, count))
        bench.advance(bench.now + 1.5)
        bench.send(1, *(("CCTXD", 1, 2, 1, f"{number:02X}" * 8) for number in range(count)))
        bench.advance(bench.now + 13.0)
        sender, receiver = bench.sentences(1), bench.sentences(2)
        assert [line.split(",")[3] for line in sender if line.startswith("CAACK")] == [
            str(n) for n in range(1, count + 1)
        ]
        assert [line.split(",")[5] for line in receiver if line.startswith("CARXD")] == [
            f"{n:02X}" * 8 for n in range(count)
        ]
        statistics = [line for line in sender + receiver if line.startswith(("CAXST", "CACST"))]
        assert all(line.split(",")[1] == "6" for line in statistics)
        assert sum(line.startswith("CAXST") for line in sender) == 1 + (rate == 0), "Goby discards that of the header"
        assert not [line for line in sender if line.startswith("CAERR")]
