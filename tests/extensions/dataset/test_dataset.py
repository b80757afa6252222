"""`sonarpost dataset export`: images with verdicts of operators in COCO format."""

import json

import numpy as np
import pytest
from builders.exports import FIRST_UTC_S, decision, image, store
from PIL import Image

from sonarpost.cli.main import main
from sonarpost.messages import Pixels
from sonarpost.services.c2.archive import Archive
from sonarpost.services.c2.config import C2Config

SIZE = {"length_m": 1.0, "width_m": 0.5}
MINE = image("0001", {**SIZE, "line_name": "line-7"}, version=2)
OTHER = image("0002", {"atd_class": "clutter"})
WRECK = image("0003", {"atd_class": "structure", "line_name": "line-7"})
NO = {"verdict": "not_mine_like"}


@pytest.fixture
def archive(tmp_path):
    """Folder of c2: three contacts with a verdict, one disputed, one unsure, one unreviewed, one without an image."""
    folder = tmp_path / "out"
    c2 = Archive(C2Config(out_dir=folder))
    records = [image("0001", SIZE), MINE, OTHER, WRECK, *(image(f"000{n}") for n in range(4, 7))]
    records.append(image("0007", codec="", model="", complete=False, missing_fraction=1.0))
    for record in records:
        c2.store_image(record, 5.0)
    for record in (
        decision("0001", decision_id="d1", image_version=1, mlo_class="moored mine", confidence=0.8),
        decision("0002", decision_id="d2", **NO),
        decision("0003", decision_id="d3", **NO),
        decision("0004", decision_id="d4"),
        decision("0004", decision_id="d5", operator="B", decided_utc_s=FIRST_UTC_S + 700, **NO),
        decision("0005", decision_id="d6", verdict="unsure"),
        decision("0007", decision_id="d7"),
    ):
        c2.store_decision(record)
    c2.flush()
    c2.close()
    return folder


def export(archive, *options, status=0):
    """Run the command with an output folder beside the archive; return that folder and the document, None if absent."""
    out = archive.parent / "dataset"
    assert main(["dataset", "export", "--archive", str(archive), "--out", str(out), *options]) == status
    file = out / "annotations.json"
    return out, json.loads(file.read_text()) if file.exists() else None


def check_coco(out, document):
    """Check the structure that https://cocodataset.org/#format-data describes for object detection."""
    assert set(document) == {"info", "licenses", "images", "annotations", "categories"}
    info = {"year": int, "version": str, "description": str, "contributor": str, "url": str, "date_created": str}
    assert {name: type(value) for name, value in document["info"].items()} == info
    images = {each["id"]: each for each in document["images"]}
    categories = {each["id"]: each["name"] for each in document["categories"]}
    assert len(images) == len(document["images"]) == len({each["file_name"] for each in images.values()})
    assert categories == {1: "mine_like", 2: "other_object", 3: "structure"}
    assert len({each["id"] for each in document["annotations"]}) == len(document["annotations"])
    for annotation in document["annotations"]:
        entry = images[annotation["image_id"]]
        x, y, width, height = annotation["bbox"]
        assert x >= 0
        assert y >= 0
        assert 0 < width <= entry["width"] - x + 0.01
        assert 0 < height <= entry["height"] - y + 0.01
        assert annotation["area"] == pytest.approx(width * height, abs=0.01)
        assert annotation["iscrowd"] == 0
        assert annotation["category_id"] in categories
    for entry in images.values():
        path = out / entry["file_name"]
        assert path.resolve().parent == (out / "images").resolve()
        with Image.open(path) as png:
            assert (png.mode, png.size) == ("L", (entry["width"], entry["height"]))


def by_name(document):
    """Return image and annotation by the image identifier of the contact."""
    images = {each["id"]: each for each in document["images"]}
    return {images[a["image_id"]]["uid"][-4:]: (images[a["image_id"]], a) for a in document["annotations"]}


def test_export_writes_images_and_annotations(archive, capsys):
    out, document = export(archive)
    check_coco(out, document)
    assert f"{out}: 3 images, 1 mine-like; 1 disputed contacts excluded, 1 unsure, 1 without an image" in (
        capsys.readouterr().out
    )
    found = by_name(document)
    assert {name: a["category_id"] for name, (_, a) in found.items()} == {"0001": 1, "0002": 2, "0003": 3}
    entry, annotation = found["0001"]
    expected = {
        "contact_id": "uuv-1/0001",
        "vehicle_id": "uuv-1",
        "line_name": "line-7",
        "group": "uuv-1/line-7",
        "ground_range_m": 20.5,
        "altitude_m": 3.5,
        "pixel_along_m": 0.25,
        "pixel_across_m": 0.125,
        "channel": "starboard",
        "image_version": 2,
        "codec": "vq",
        "bytes_received": 232,
        "pixels_sha256": MINE.pixels_sha256,
    }
    assert expected.items() <= entry.items()
    expected = {
        "bbox": [10.0, 6.0, 4.0, 4.0],
        "bbox_is_measured": True,
        "verdict": "mine_like",
        "operator": "A. Operator",
        "mlo_class": "moored mine",
        "operator_confidence": 0.8,
        "decided_version": 1,
        "disputed": False,
    }
    assert expected.items() <= annotation.items()
    assert annotation["decided_utc"] == "2016-10-12T09:10:01.250Z"
    with Image.open(out / entry["file_name"]) as png:
        assert np.array_equal(np.asarray(png), MINE.pixels.to_array())


def test_disputed_contacts_are_included_on_request_and_the_next_export_replaces_them(archive, capsys):
    out, document = export(archive, "--include-disputed")
    check_coco(out, document)
    _, annotation = by_name(document)["0004"]
    assert (annotation["verdict"], annotation["disputed"], annotation["operators"]) == ("mine_like", True, 2)
    capsys.readouterr()
    out, document = export(archive, "--json")
    check_coco(out, document)
    assert len(document["images"]) == 3
    _, annotation = by_name(document)["0002"]  # an object of unknown size
    assert (annotation["bbox"], annotation["bbox_is_measured"]) == ([0.0, 0.0, 24.0, 16.0], False)
    counts = {"disputed": 1, "unsure": 1, "unreviewed": 1, "without_image": 1, "rejected": 0}
    counts |= {"out": str(out), "images": 3, "mine_like": 1, "not_mine_like": 2}
    assert json.loads(capsys.readouterr().out) == counts


@pytest.mark.parametrize(
    ("later", "expected"),
    [
        (NO, ("not_mine_like", False)),
        ({"verdict": "unsure"}, None),
        ({**NO, "operator": "B", "decided_utc_s": FIRST_UTC_S + 500}, None),
    ],
)
def test_later_verdict_counts(later, expected, tmp_path):
    """Of one operator the later verdict replaces the earlier one; of two operators they are a dispute."""
    first = decision("0001", decision_id="z")
    second = decision("0001", decision_id="a", **{"decided_utc_s": FIRST_UTC_S + 900, **later})
    kept = [image("0002"), decision("0002", decision_id="k")]
    _, document = export(store(tmp_path / "out", image("0001"), second, first, *kept))
    found = by_name(document).get("0001")
    assert (found and (found[1]["verdict"], found[1]["disputed"])) == expected


def test_filters(tmp_path):
    others = {"0002": {"vehicle_id": "uuv-2"}, "0003": {"vessel_id": "vessel-2"}}
    records = [image("0004", first_frame_utc_s=FIRST_UTC_S + 86400, last_frame_utc_s=FIRST_UTC_S + 86401)]
    names = ("0001", "0002", "0003", "0004")
    records += [image(name, **others.get(name, {})) for name in names[:3]]
    later_s = FIRST_UTC_S + 90000
    records += [decision(name, decision_id=name, decided_utc_s=later_s, **others.get(name, {})) for name in names]
    archive = store(tmp_path / "out", *records)
    for options, expected in (
        ("--vehicle uuv-2", ["0002"]),
        ("--vessel vessel-2", ["0003"]),
        ("--since 2016-10-13", ["0004"]),
        ("", list(names)),
    ):
        assert sorted(by_name(export(archive, *options.split())[1])) == expected


def test_groups_without_a_line_name_are_separated_by_time(tmp_path):
    times = {"0001": 0.0, "0002": 1200.0, "0003": 2400.0, "0004": 9000.0}
    records = [image(name, {"time_utc_s": FIRST_UTC_S + after_s}) for name, after_s in times.items()]
    records += [decision(name, decision_id=name) for name in times]
    _, document = export(store(tmp_path / "out", *records))
    found = {name: entry["group"] for name, (entry, _) in by_name(document).items()}
    first = "uuv-1/2016-10-12T09:00:01.250Z"
    assert found == {"0001": first, "0002": first, "0003": first, "0004": "uuv-1/2016-10-12T11:30:01.250Z"}


def test_no_verdict_is_reported_and_nothing_is_written(tmp_path, capsys):
    archive = store(tmp_path / "out", image("0001"), image("0002"), decision("0002", verdict="unsure"))
    out, document = export(archive, "--json", status=1)
    assert document is None
    assert not out.exists()
    output = capsys.readouterr()
    assert json.loads(output.out)["out"] is None
    assert "no contact with a usable verdict (disputed 0, unsure 1, unreviewed 1, without image 0)" in output.err


@pytest.mark.parametrize("contact_id", ["../../../etc/passwd", "a/b\\c\x00.png", "..", "\x1b[31m", "x" * 120, "CON"])
def test_hostile_contact_id_is_text_only(contact_id, tmp_path, capsys):
    contact = {"contact_id": contact_id, "line_name": "../\x1b[31m"}
    record = image("0001")
    hostile = record.model_copy(update={"contact": record.contact.model_copy(update=contact)})
    out, document = export(store(tmp_path / "out", hostile, decision("0001")))
    check_coco(out, document)
    assert document["images"][0]["contact_id"] == contact_id
    assert "\x1b" not in capsys.readouterr().out
    written = sorted(path.name for path in tmp_path.rglob("*") if path.is_file() and out in path.parents)
    assert written == ["annotations.json", "sonarpost.vessel-1.uuv-1.20161012T090001Z.0001.png"]


def test_hostile_identifier_in_a_side_car_is_rejected(tmp_path, capsys):
    archive = store(tmp_path / "out", image("0001"), decision("0001"), image("0002"), decision("0002", decision_id="e"))
    (side_car,) = (archive / "vessel-1").glob("*_0002_v1.json")
    side_car.write_text(side_car.read_text().replace('"uuv-1"', '"../uuv"'))
    out, document = export(archive, status=1)
    check_coco(out, document)
    assert list(by_name(document)) == ["0001"]
    assert "rejected: " in capsys.readouterr().err


def test_damaged_image_is_rejected_and_the_others_written(archive, capsys):
    for content in (b"\x89PNG", b""):
        next((archive / "vessel-1").glob("*_0002_v1.png")).write_bytes(content)
        out, document = export(archive, status=1)
        check_coco(out, document)
        assert sorted(by_name(document)) == ["0001", "0003"]
        assert "0002_v1.png" in capsys.readouterr().err


def test_exchanged_image_is_rejected(archive, capsys):
    path = next((archive / "vessel-1").glob("*_0002_v1.png"))
    Image.fromarray(np.zeros((16, 24), np.uint8)).save(path)
    _, document = export(archive, status=1)
    assert "0002" not in by_name(document)
    assert "pixels_sha256" in capsys.readouterr().err


def test_image_of_16_bits_is_scaled_to_8_bits(tmp_path):
    pixels = np.linspace(0, 4095, 64 * 64).astype(np.uint16).reshape(64, 64)
    record = image("0001", pixels=Pixels.from_array(pixels))
    out, document = export(store(tmp_path / "out", record, decision("0001")))
    check_coco(out, document)
    with Image.open(out / document["images"][0]["file_name"]) as png:
        written = np.asarray(png)
    assert (written.min(), written.max()) == (0, 255)
    assert abs(int(written[32, 0]) - 128) <= 1


def test_missing_archive_and_unwritable_folder_are_named(archive, tmp_path, capsys):
    assert main(["dataset", "export", "--archive", str(tmp_path / "absent"), "--out", str(tmp_path / "d")]) == 2
    assert "absent: got 'No such file or directory', expected the out_dir of c2" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert main(["dataset", "export", "--archive", str(archive), "--out", str(tmp_path / "file")]) == 2
    assert "output folder: got" in capsys.readouterr().err
