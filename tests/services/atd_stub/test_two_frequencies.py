"""atd_stub with dual-frequency sonars: files are joined, and contacts equal those of the first frequency alone."""

import pytest
from builders.joined_surveys import FEW_CANDIDATES, RANGE_M, SAMPLES, Box, detect_in_files, near, split, survey_of
from builders.two_frequencies import with_second_frequency

from sonarpost.services.atd_stub.config import AtdStubConfig
from sonarpost.services.atd_stub.file_boundary import StoredEnd, pack, unpack
from sonarpost.services.atd_stub.survey_detection import detect_in_survey
from sonarpost.sonar.readers import read_survey

CONFIG = AtdStubConfig(join_timeout_s=30.0, detector=FEW_CANDIDATES)
SECOND = pytest.mark.parametrize(("samples", "range_m"), [(SAMPLES, RANGE_M), (320, 12.5), (1024, 60.0)])


@SECOND
def test_dual_frequency_files_are_joined(samples, range_m, tmp_path):
    survey = with_second_frequency(survey_of(300, Box(150)), samples, range_m)
    paths = split(tmp_path, survey, (0, 149), (149, 300))
    read = [read_survey(path) for path in paths]
    assert [len(ping.channels) for ping in (read[0].pings[-1], read[1].pings[0])] == [2, 2]
    assert len(near(detect_in_files(paths, join_timeout_s=30.0), 150)) == 1
    [end] = detect_in_survey(paths[0], "0" * 64, "uuv-1", CONFIG).ends.values()
    restored = unpack(pack(StoredEnd(end, 130.0))).end
    assert detect_in_survey(paths[1], "1" * 64, "uuv-1", CONFIG, {end.sonar_id: restored}).joined
