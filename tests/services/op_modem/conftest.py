"""Fixtures of these tests: the service of vessel-1 with short delays, and its consumer."""

import pytest

from sonarpost import keys
from sonarpost.messages import ReceivedImage
from sonarpost.security.acoustic_key import create_key
from sonarpost.services.op_modem.config import OpModemConfig
from sonarpost.services.op_modem.service import OpModemService

VESSEL = "vessel-1"


@pytest.fixture
def key_file(tmp_path):
    create_key(tmp_path / "acoustic.key")
    return tmp_path / "acoustic.key"


@pytest.fixture
def begin(runner, platform, modem_pair):
    """Start the service with the given options; it authenticates frames if there is a key file."""

    def start(name=VESSEL, *, key_file=None, **options):
        usual = {
            "port": modem_pair.port(modem_pair.VESSEL),
            "vehicles": {"3": "uuv-1"},
            "retry_s": 0.5,
            "holdoff_s": 0.05,
        }
        auth = "none" if key_file is None else "key"
        there = platform(name).model_copy(update={"acoustic_auth": auth, "acoustic_key_file": key_file})
        return runner.start(OpModemService(there, OpModemConfig(**(usual | options))))

    return start


@pytest.fixture
def decompressor(runner):
    return runner.peer(VESSEL, "decompressor", {keys.acoustic_image(VESSEL): ReceivedImage})


@pytest.fixture
def complete(decompressor):
    """Return the numbers of the images that are complete."""
    return lambda: {int(image.image_id, 36) for image in decompressor.received if image.complete}
