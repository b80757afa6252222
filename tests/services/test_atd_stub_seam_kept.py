"""The end of a file as a store holds it: what was written before is read, and written again byte for byte."""

from __future__ import annotations

import numpy as np
from builders.common import GOLDEN_FOLDER

from sonarpost.services.atd_stub.seam import Origin, SeamLook, pack, unpack
from sonarpost.sonar.survey import Side

GOLDEN = GOLDEN_FOLDER / "atd_stub" / "seam-format-1.hex"


def test_a_seam_of_format_1_is_read_and_stays_as_it_is():
    packed = bytes.fromhex(GOLDEN.read_text())
    seam = unpack(packed)
    first, second = Origin("0a" * 32, "line-0.xtf", "line-0"), Origin("1b" * 32, "line-1.xtf", "line-1")
    assert (seam.sonar_id, seam.until_utc_s, seam.origins) == ("made", 1.0e9 + 30.0, (first, first, second))
    assert seam.looks == (
        SeamLook(Side.PORT, -2, -5, 1, 11.25, 0.2),
        SeamLook(Side.STARBOARD, 1, 0, 3, 12.5, 0.125, b"\x81a snippet's payload"),
    )
    assert seam.held == (b"\x81a snippet's payload",)
    assert [ping.number for ping in seam.pings] == [98, 99, 100]
    assert (seam.pings[0].pitch_deg, seam.pings[0].roll_deg, seam.pings[1].lat_deg) == (0.5, -0.25, None)
    starboard = seam.pings[2].channel(Side.STARBOARD)
    assert (starboard.frequency_hz, starboard.scale, starboard.samples.dtype) == (600e3, 0.5, np.uint16)
    np.testing.assert_array_equal(starboard.samples, [7, 8, 65535])
    assert pack(seam) == packed
