"""A new classifier from verdicts: the data set, its division, its examples, and errors."""

import importlib.util
import json
import shutil

import numpy as np
import pytest
from builders.exports import decision, image

from research.detection import finetune
from research.detection.finetune import LabelledContact, contact_examples, load_dataset, split_by_group
from sonarpost.cli.main import main
from sonarpost.detection.classifier import MINE_LIKE_OBJECT, OTHER_OBJECT
from sonarpost.detection.images import ScaledImage
from sonarpost.errors import ConfigError
from sonarpost.messages import Pixels
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config


def object_pixels(seed, *, with_object=True):
    rng = np.random.default_rng(seed)
    pixels = rng.rayleigh(50, (100, 140))
    if with_object:
        pixels[45:55, 64:74] *= 3.5
        pixels[45:55, 74:100] *= 0.05
    return np.clip(pixels, 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Folder of `sonarpost dataset export` of ten contacts on five survey lines; the even ones are mine-like."""
    folder = tmp_path_factory.mktemp("archive")
    archive = Archive(C2Config(out_dir=folder / "c2"))
    for number in range(10):
        contact = {"line_name": f"line-{number % 5}", "pixel_along_m": 0.1, "pixel_across_m": 0.06}
        name = f"{number:04d}"
        archive.store_image(image(name, contact, pixels=Pixels.from_array(object_pixels(number))), 5.0)
        verdict = "mine_like" if number % 2 == 0 else "not_mine_like"
        archive.store_decision(decision(name, decision_id=f"d{number}", verdict=verdict))
    archive.flush()
    archive.close()
    assert main(["dataset", "export", "--archive", str(folder / "c2"), "--out", str(folder / "dataset")]) == 0
    return folder / "dataset"


def test_exported_contacts_are_read_and_no_survey_line_is_in_both_parts(dataset):
    found = load_dataset(dataset)
    assert [contact.label for contact in found].count(MINE_LIKE_OBJECT) == 5
    assert [contact.label for contact in found].count(OTHER_OBJECT) == 5
    assert {contact.group for contact in found} == {f"uuv-1/line-{n}" for n in range(5)}
    assert (found[0].image.pixel_along_m, found[0].image.pixel_across_m) == (0.1, 0.06)
    assert found[0].image.pixels.shape == (100, 140)
    train, test = split_by_group(load_dataset(dataset))
    assert (len(train), len(test)) == (8, 2)
    assert not {c.group for c in train} & {c.group for c in test}
    with pytest.raises(ConfigError, match="at least 2 survey lines"):
        split_by_group(train[:1])


def test_examples_are_the_candidates_at_the_centre(dataset):
    contacts = load_dataset(dataset)
    examples = contact_examples(contacts)
    assert set(examples.label.tolist()) == {MINE_LIKE_OBJECT, OTHER_OBJECT}
    assert len(np.unique(examples.group)) == 5
    highlight = examples.fine[:, 18:23, 14:19, 0].mean(axis=(1, 2))
    assert (highlight > 5).all()
    empty = LabelledContact(ScaledImage(np.zeros((64, 64), np.uint8), 0.1, 0.1), OTHER_OBJECT, "a")
    with pytest.raises(ConfigError, match="no candidate"):
        contact_examples([empty])


def test_error_names_what_is_invalid(dataset, tmp_path):
    with pytest.raises(ConfigError, match="a data set of dataset export"):
        load_dataset(tmp_path)
    shutil.copytree(dataset / "images", tmp_path / "images")
    for change, message in (
        (lambda d: d.pop("images"), "KeyError"),
        (lambda d: d["images"][0].update(file_name="../../outside.png"), "outside the data set"),
        (lambda d: d["images"][0].update(file_name="/etc/passwd"), "outside the data set"),
        (lambda d: d["images"][0].update(pixel_along_m="wide"), "could not convert"),
        (lambda d: d["images"][0].update(pixel_across_m=-1), "pixel sizes"),
        (lambda d: d["annotations"][0].update(image_id=999), "KeyError"),
        (lambda d: d.update(annotations=3), "TypeError"),
    ):
        document = json.loads((dataset / "annotations.json").read_text())
        change(document)
        (tmp_path / "annotations.json").write_text(json.dumps(document))
        with pytest.raises(ConfigError, match=message):
            load_dataset(tmp_path)


@pytest.mark.skipif(importlib.util.find_spec("torch") is not None, reason="PyTorch is installed")
def test_without_pytorch_the_error_names_it(dataset, tmp_path, capsys):
    assert finetune.main(["--dataset", str(dataset), "--out", str(tmp_path / "new.npz")]) == 2
    assert "PyTorch" in capsys.readouterr().err
    assert not (tmp_path / "new.npz").exists()
