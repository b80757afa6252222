"""The rules of the fuzzer on fixed inputs: damaged golden streams and random bodies, in bounded time and memory."""

import resource
import time
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from builders.codec_oracle import (
    as_input,
    check,
    codec_for,
    codec_ids,
    golden_streams,
    new_streams,
    stream_of,
    valid_header,
)
from hypothesis import given
from hypothesis import strategies as st

from sonarpost.codec.interface import MAX_SIDE_PX, StreamHeader
from sonarpost.codec.registry import default_registry

NAMES = default_registry().names()
MAX_CPU_S = 5.0
"""Maximum processor time of an input, or 30 times that of the largest image. The slowest codec needs a tenth of it."""
MAX_GROWTH_MIB = 200.0
"""Maximum growth of the peak memory of the process by all inputs."""


def damaged(stream, rng, others, kinds):
    """Yield the stream truncated, with changed, removed and repeated bytes, and joined with another one."""
    body = StreamHeader.unpack(stream).size
    for kind in kinds:
        data = bytearray(stream)
        first, last = sorted(rng.integers(0, len(data), 2).tolist())
        match kind % 6:
            case 0:
                del data[first:]
            case 1:
                data[int(rng.integers(0, len(data)))] ^= 1 << int(rng.integers(0, 8))
            case 2:
                data[first:last] = rng.integers(0, 256, last - first, dtype=np.uint8).tobytes()
            case 3:
                del data[first:last]
            case 4:
                data[first:first] = data[first : first + 40]
            case _:
                data[max(first, body) :] = others[int(rng.integers(0, len(others)))][first:]
        yield bytes(data)


def random_bodies(codec_id, rng):
    """Yield bodies of noise, zeros and ones after valid headers, from the smallest to the largest image."""
    for height_px, width_px in ((16, 16), (33, 47), (MAX_SIDE_PX, MAX_SIDE_PX)):
        header = valid_header(codec_id, height_px, width_px).pack()
        for length in (0, 1, 2, 3, 7, 60, 700):
            yield header + rng.integers(0, 256, length, dtype=np.uint8).tobytes()
            yield header + bytes([int(rng.choice((0, 0x7F, 0x80, 0xFF)))]) * length


def peak_mib():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def timed(stream, ids):
    start_s = time.process_time()
    return check(stream, None, ids), time.process_time() - start_s


@pytest.mark.parametrize("name", NAMES)
def test_damaged_streams_decode_or_are_rejected_in_bounded_time_and_memory(name):
    rng, ids = np.random.default_rng(0), codec_ids([name])
    streams = [stream for stream in (*golden_streams(ids), *new_streams(ids)) if len(stream) <= 1500]
    assert streams
    largest = valid_header(ids[0], MAX_SIDE_PX, MAX_SIDE_PX).pack()
    for start in (streams[0], largest + bytes(range(1, 200))):  # loads libraries and machine code
        check(start, None, ids)
    limit_s = max(MAX_CPU_S, 30 * timed(largest + bytes(range(1, 200)), ids)[1])
    before_mib = peak_mib()
    outcomes = Counter()
    # Two of the six kinds of damage for each stream; every kind has the same share.
    inputs = [b for n, stream in enumerate(streams) for b in damaged(stream, rng, streams, (n, n + 3))]
    for bad in (*inputs, *(body for codec_id in ids for body in random_bodies(codec_id, rng))):
        outcome, cpu_s = timed(bad, ids)
        assert cpu_s < limit_s, (len(bad), bad[:16].hex())
        outcomes[outcome] += 1
    assert peak_mib() - before_mib < MAX_GROWTH_MIB
    assert outcomes["rejected"] > 0
    assert outcomes["complete"] + outcomes["concealed"] > 0


@pytest.mark.parametrize("name", NAMES)
def test_valid_streams_are_complete_and_with_a_gap_raise_stream_errors_only(name):
    rng, ids = np.random.default_rng(1), codec_ids([name])
    for stream in new_streams(ids):
        assert check(stream, None, ids) == "complete"
        length = len(stream) - StreamHeader.unpack(stream).size
        first = int(rng.integers(0, length))
        received = np.ones(length, dtype=np.bool_)
        received[first : first + 1 + length // 3] = False
        check(stream, received, ids)


@given(data=st.binary(max_size=120))
def test_random_bytes_decode_or_are_rejected(data):
    ids = codec_ids()
    stream, received = stream_of(data, ids)
    check(stream, received, ids)


def test_inputs_of_the_fuzzer_parse_to_their_streams():
    ids = codec_ids()
    for codec_id in ids:
        stream = next(s for s in new_streams([codec_id]) if StreamHeader.unpack(s).height_px != 17)
        for flags in range(4):
            read, received = stream_of(as_input(stream, flags, ids), ids)
            assert read == stream
            assert (received is None) == (flags < 2)
            if received is not None:
                assert np.flatnonzero(~received).tolist() == [3, 4]


def test_check_detects_invalid_decoders(monkeypatch):
    """A decoder with visible missing pixels, one with another size, and one that raises another exception."""
    codec_id = 0x20
    codec = type(codec_for(codec_id))
    stream = next(new_streams([codec_id]))
    original = codec.decode
    for change, error in (
        (lambda decoded: replace(decoded, image=decoded.image | 1, missing=~decoded.missing), AssertionError),
        (lambda decoded: replace(decoded, image=decoded.image[1:], missing=decoded.missing[1:]), AssertionError),
        (lambda decoded: decoded.image[len(decoded.image)], IndexError),
    ):

        def decode(self, stream, received=None, change=change):
            return change(original(self, stream, received))

        monkeypatch.setattr(codec, "decode", decode)
        with pytest.raises(error):
            check(stream, None, [codec_id])
