"""What c2 has accepted while the console ashore was away, read from c2's folder."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from sonarpost.errors import BadInputError, StoredFileError
from sonarpost.export.contacts import DECISIONS, SideCar
from sonarpost.logs import kv
from sonarpost.messages import Decision, Pixels, ReconstructedImage
from sonarpost.sonar.image_files import read_image

log = logging.getLogger(__name__)

_MAX_FILE_BYTES = 1 << 20


def kept_in(out_dir: Path) -> Iterator[ReconstructedImage | Decision]:
    """Yield every picture and decision that c2 keeps, pictures first; what cannot be read is logged and left out.

    The folder does not say which pixels are missing, only which rows and how many: such a picture is given with all of
    those rows missing, so that nothing that was not received looks measured.

    Args:
        out_dir: c2's folder, with one folder a vessel.
    """
    try:
        folders = sorted(path for path in out_dir.iterdir() if path.is_dir())
    except OSError as error:
        log.error("c2's folder is not read", extra=kv(folder=out_dir, reason=str(error)))
        return
    for folder in folders:
        for path in sorted(folder.glob("*.json")):
            try:
                yield _picture(path)
            except (BadInputError, ValidationError, OSError) as error:
                log.warning("Kept picture left out", extra=kv(file=path, reason=str(error)))
    for folder in folders:
        for path in sorted((folder / DECISIONS).glob("*.json")):
            try:
                yield Decision.model_validate_json(_text(path))
            except (BadInputError, ValidationError, OSError) as error:
                log.warning("Kept decision left out", extra=kv(file=path, reason=str(error)))


def _text(path: Path) -> bytes:
    with path.open("rb") as file:
        text = file.read(_MAX_FILE_BYTES + 1)
    if len(text) > _MAX_FILE_BYTES:
        raise StoredFileError(
            str(path), "size", f"more than {_MAX_FILE_BYTES} bytes", f"at most {_MAX_FILE_BYTES} bytes"
        )
    return text


def _picture(path: Path) -> ReconstructedImage:
    text = _text(path)
    car = SideCar.model_validate_json(text)
    picture = Pixels.from_array(read_image(path.with_suffix(".tiff")))
    mask = np.zeros((picture.height_px, picture.width_px), np.bool_)
    said = json.loads(text)
    rows = said.get("missing_rows") or []
    if rows:
        first, behind = int(rows[0]), int(rows[-1])
        mask[max(0, first) : behind] = True
    return ReconstructedImage(
        **car.model_dump(exclude={"type", "v", "height_px", "width_px", "contact"}),
        contact=car.contact,
        model=str(said.get("model", "")),
        picture=picture,
        missing_mask=np.packbits(mask).tobytes() if mask.any() else b"",
    )
