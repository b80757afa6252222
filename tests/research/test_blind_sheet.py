"""`python -m research.recognition.blind_sheet`: choice of the crops, the sheet, evaluation of judgements."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from research.common.images import SampleImage
from research.recognition.blind_sheet import COUNT, chosen_crops, evaluate, main
from sonarpost.errors import ConfigError

CROPS = [SampleImage(str(n), str(n), np.zeros((16, 16), np.uint8), is_target=n % 3 == 0) for n in range(90)]


def test_half_of_the_chosen_crops_have_a_target() -> None:
    chosen = chosen_crops(CROPS, 1)
    assert len({crop.name for crop in chosen}) == COUNT
    assert sum(bool(crop.is_target) for crop in chosen) == COUNT // 2
    assert [crop.name for crop in chosen] == [crop.name for crop in chosen_crops(CROPS, 1)]
    assert [crop.name for crop in chosen] != [crop.name for crop in chosen_crops(CROPS, 2)]
    # The order does not give the targets away.
    assert 4 < sum(bool(crop.is_target) for crop in chosen[: COUNT // 2]) < 16
    with pytest.raises(ConfigError, match="10 crops"):
        chosen_crops(CROPS[:30], 1)


def test_judgements_are_evaluated() -> None:
    has_target = [n % 2 == 0 for n in range(COUNT)]
    right = [9 if one else 2 for one in has_target]
    three_wrong = [2, 9, 2, *right[3:]]
    rows = evaluate({"original": right, "emb": three_wrong, "guess": [5] * COUNT}, has_target)
    assert rows[0] == ("original", 1.0, COUNT)
    assert rows[1] == ("emb", pytest.approx((18 * 19 + (18 + 2 * 19) / 2) / 400), COUNT - 3)
    assert rows[2] == ("guess", 0.5, COUNT // 2)
    assert evaluate({"emb": right}, has_target) == [("emb", 1.0, None)]


@pytest.mark.realdata
def test_sheets_of_codecs_show_the_same_crops(tmp_path: Path, data_dir: Path) -> None:
    sdvd = ("--sdvd", str(data_dir / "snippets" / "sdvd"))
    sheets = {}
    for codec in ("original", "huffman"):
        out = tmp_path / f"{codec}.png"
        assert main([*sdvd, "--codec", codec, "--budget", "512", "--out", str(out)]) == 0
        with Image.open(out) as sheet:
            sheets[codec] = np.asarray(sheet.convert("L"), float)
    assert np.corrcoef(sheets["original"].ravel(), sheets["huffman"].ravel())[0, 1] > 0.9
    judgements = tmp_path / "judgements.json"
    judgements.write_text(json.dumps({"original": [5] * COUNT}))
    assert main([*sdvd, "--judgements", str(judgements)]) == 0
