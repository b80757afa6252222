"""decompressor: retention of the image files."""

from __future__ import annotations

import os
import time

from builders.common import eventually
from builders.records import reconstructed_image

from sonarpost.archive.image_files import write_image
from sonarpost.messages import Pixels
from sonarpost.services.decompressor.config import DecompressorConfig
from sonarpost.services.decompressor.service import DecompressorService

YEAR_S = 366 * 86400.0


def image(image_id: str):
    picture = Pixels(height_px=20, width_px=30, bits=8, data=bytes(600))
    return reconstructed_image(picture, image_id=image_id)


def test_decompressor_removes_old_image_files_by_default(runner, platform, tmp_path):
    write_image(tmp_path / "out", image("AAAA"))
    write_image(tmp_path / "out", image("BBBB"))
    [old] = (tmp_path / "out").glob("*AAAA_v1.tiff")
    past_s = time.time() - YEAR_S
    for path in (tmp_path / "out").glob(f"{old.stem}.*"):
        os.utime(path, (past_s, past_s))
    service = runner.start(DecompressorService(platform("vessel-1"), DecompressorConfig(out_dir=tmp_path / "out")))
    # The files of an image are removed one after another.
    eventually(lambda: {path.stem.split("_")[-2] for path in (tmp_path / "out").iterdir()} == {"BBBB"})
    eventually(lambda: service.health().counters.get("images_removed") == 1)
