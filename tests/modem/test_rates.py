import pytest

from sonarpost.modem.micromodem import RATES


@pytest.mark.parametrize(("rate", "packet_bytes"), [(0, 32), (1, 192), (4, 512), (5, 2048)])
def test_packet_sizes_match_the_paper(rate: int, packet_bytes: int) -> None:
    assert RATES[rate].packet_bytes == packet_bytes


@pytest.mark.parametrize(("rate", "bps"), [(0, 80), (1, 250), (2, 500), (3, 1200), (4, 1300), (5, 5300), (6, 490)])
def test_air_times_match_the_published_throughput(rate: int, bps: int) -> None:
    assert RATES[rate].throughput_bps == pytest.approx(bps, rel=0.05)


def test_rate_table_is_complete_and_read_only() -> None:
    assert sorted(RATES) == list(range(7))
    assert all(number == rate.number for number, rate in RATES.items())
    with pytest.raises(TypeError):
        RATES[7] = RATES[0]  # type: ignore[index]
