import pytest

from sonarpost.modem.micromodem import RATES

# Bytes of a packet (Table I of the paper; None where it has none) and the published throughput in bit/s.
PUBLISHED = {
    0: (32, 80),
    1: (192, 250),
    2: (None, 500),
    3: (None, 1200),
    4: (512, 1300),
    5: (2048, 5300),
    6: (None, 490),
}


def test_rates_match_the_published_ones_and_are_read_only() -> None:
    assert RATES.keys() == PUBLISHED.keys()
    for number, (packet_bytes, bps) in PUBLISHED.items():
        assert RATES[number].number == number
        assert RATES[number].packet_bytes == packet_bytes or packet_bytes is None
        assert RATES[number].throughput_bps == pytest.approx(bps, rel=0.05)
    with pytest.raises(TypeError):
        RATES[7] = RATES[0]  # type: ignore[index]
