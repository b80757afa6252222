"""A recorded layback that is not applied: the contact record, the health and the next file of the line say so."""

import math
import struct

from builders.common import eventually
from builders.joined_surveys import FEW_CANDIDATES, Box, near, split, survey_of

from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.survey_detection import detect_in_survey
from sonarpost.sonar.geometry import Position, offset_between_m

LAYBACK_OFFSET = 184
NOTE = "recorded layback of 45 m is not applied"


def with_layback(path, layback_m=45.0):
    """Write a layback into each ping of an XTF file, whose positions of sensor and ship are equal."""
    data = bytearray(path.read_bytes())
    offset = 1024
    while offset < len(data):
        struct.pack_into("<f", data, offset + LAYBACK_OFFSET, layback_m)
        offset += struct.unpack_from("<I", data, offset + 10)[0]
    path.write_bytes(data)


def test_layback_that_is_not_applied_is_in_the_contact_and_in_the_health(start_service, compressor, incoming, tmp_path):
    paths = split(tmp_path, survey_of(300, Box(75), Box(150)), (0, 150), (150, 300))
    for path in paths:
        with_layback(path)
    service = start_service(join_timeout_s=60.0)
    for path in paths:
        path.rename(incoming / path.name)
    # The object on the boundary of the files is seen whole with pings that the store has kept.
    eventually(lambda: len(compressor.received) >= 2)
    assert all(NOTE in snippet.contact.position_note for snippet in compressor.received)
    eventually(lambda: f"line-1.xtf: {NOTE}" in service.health().detail)


def test_layback_that_is_applied_moves_the_contact_and_widens_its_error(tmp_path):
    [path] = split(tmp_path, survey_of(150, Box(75)), (0, 150))
    with_layback(path)
    plain, applied = (
        detect_in_survey(path, "0" * 64, "uuv-1", AtdStubConfig(detector=FEW_CANDIDATES, recorded_layback=use))
        for use in ("auto", "apply")
    )
    assert (NOTE in plain.position_note, applied.position_note) == (True, None)
    [before], [after] = near(list(plain.snippets), 75), near(list(applied.snippets), 75)
    assert (NOTE in before.contact.position_note, after.contact.position_note) == (True, None)
    north_m, east_m = offset_between_m(
        *(Position(each.contact.lat_deg, each.contact.lon_deg) for each in (before, after))
    )
    assert round(math.hypot(north_m, east_m)) == 45
    assert after.contact.position_sigma_m > before.contact.position_sigma_m
