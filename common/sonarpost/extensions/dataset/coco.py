"""Training data: contacts with an operator's verdict in COCO format (https://cocodataset.org/#format-data).

The label is the verdict of the decision that counts (`sonarpost.review.decisions`). A contact is disputed if one
operator's verdict is mine-like and another's is not mine-like.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from sonarpost.errors import StoredFileError
from sonarpost.export.contacts import ExportContact
from sonarpost.export.tables import FURTHER_FIELDS
from sonarpost.export.text import utc_text
from sonarpost.messages import Decision, Pixels
from sonarpost.sonar.image_files import read_image

IMAGES_FOLDER: Final = "images"
ANNOTATIONS_FILE: Final = "annotations.json"
CATEGORIES: Final[Mapping[int, str]] = {1: "mine_like", 2: "other_object", 3: "structure"}
_STRUCTURE_CLASS: Final = "structure"
"""Class that the detector gives to wrecks, walls and outcrops."""
_SAME_LINE_S: Final = 1800.0
_BRIGHT_PERCENTILE: Final = 99.9
"""Percentile of a 16-bit image that becomes 255."""

LabelState = Literal["labelled", "disputed", "unsure", "unreviewed", "without_image"]
GreyImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


@dataclass(frozen=True, slots=True)
class LabelledImage:
    """A contact with its label and the pixels of the latest version of its image.

    Attributes:
        contact: The contact; it has a side-car, decisions and an image.
        decision: The decision that counts, mine-like or not.
        is_disputed: Whether operators disagree.
        operators: Number of operators with a verdict, mine-like or not.
        pixels: Shape (rows, columns), uint8.
    """

    contact: ExportContact
    decision: Decision
    is_disputed: bool
    operators: int
    pixels: npt.NDArray[np.uint8]

    @property
    def file_name(self) -> str:
        """Path of the image in the data set. It consists of checked identifiers, never of the contact identifier."""
        return f"{IMAGES_FOLDER}/{self.contact.uid}.png"

    @property
    def category_id(self) -> int:
        """Key of `CATEGORIES`: from the verdict, and for other objects from the class of the detector."""
        if self.decision.verdict == "mine_like":
            return 1
        contact = self.contact.image.contact
        return 3 if contact is not None and contact.atd_class == _STRUCTURE_CLASS else 2


def label_state(contact: ExportContact) -> LabelState:
    """Return whether a contact has a label, or why it has none. `disputed` ones have a label that is in doubt."""
    state = contact.review
    if state in ("unreviewed", "unsure"):
        return state
    if contact.image_path is None:
        return "without_image"
    return "disputed" if state == "disputed" else "labelled"


def load_labelled_image(contact: ExportContact) -> LabelledImage:
    """Read the image of a contact whose state is `labelled` or `disputed`.

    Raises:
        SurveyFileError: The image cannot be read.
        StoredFileError: Its pixels are not those that c2 received.
        ValueError: The contact has another state.
    """
    state = label_state(contact)
    if state not in ("labelled", "disputed") or contact.decision is None or contact.image_path is None:
        raise ValueError(f"contact: got {state}, expected labelled or disputed")
    pixels = read_image(contact.image_path)
    sha256 = Pixels.from_array(pixels).sha256
    if sha256 != contact.image.pixels_sha256:
        raise StoredFileError(str(contact.image_path), "pixels_sha256", sha256, contact.image.pixels_sha256)
    operators = sum(decision.verdict != "unsure" for decision in contact.result.standing)
    return LabelledImage(contact, contact.decision, state == "disputed", operators, to_8_bits(pixels))


def to_8_bits(pixels: GreyImage) -> npt.NDArray[np.uint8]:
    """Return 8-bit pixels unchanged, 16-bit ones divided so that their 99.9th percentile is 255."""
    if pixels.dtype == np.uint8:
        return pixels.astype(np.uint8)
    bright = max(1.0, float(np.percentile(pixels, _BRIGHT_PERCENTILE)))
    return np.clip(np.rint(pixels.astype(np.float64) * (255.0 / bright)), 0, 255).astype(np.uint8)


def groups(contacts: Sequence[ExportContact]) -> dict[str, str]:
    """Return the group of each contact by its `uid`. Training and test data must not share a group.

    A group is a survey line of a vehicle. The acoustic link does not carry the name of the line. Without it, contacts
    of a vehicle that are less than 30 minutes apart are one group, named by the time of its first contact.
    """
    found: dict[str, str] = {}
    last: dict[str, tuple[str, float]] = {}
    for contact in sorted(contacts, key=_seen_utc_s):
        vehicle_id, record = contact.image.vehicle_id, contact.image.contact
        if record is not None and record.line_name:
            found[contact.uid] = f"{vehicle_id}/{record.line_name}"
            continue
        seen_utc_s = _seen_utc_s(contact)
        group, before_utc_s = last.get(vehicle_id, ("", -_SAME_LINE_S))
        if not group or seen_utc_s - before_utc_s > _SAME_LINE_S:
            group = f"{vehicle_id}/{utc_text(seen_utc_s)}"
        last[vehicle_id] = group, seen_utc_s
        found[contact.uid] = group
    return found


def _seen_utc_s(contact: ExportContact) -> float:
    record = contact.image.contact
    if record is None or record.time_utc_s is None:
        return contact.image.first_frame_utc_s
    return record.time_utc_s


def coco_document(
    images: Iterable[LabelledImage], group_of: Mapping[str, str], created_utc_s: float
) -> dict[str, object]:
    """Return the content of `annotations.json`; identifiers count from 1 in the given order.

    Args:
        images: The images, one annotation each.
        group_of: Result of `groups`.
        created_utc_s: Time of the export.
    """
    created = datetime.fromtimestamp(created_utc_s, UTC)
    numbered = list(enumerate(images, start=1))
    return {
        "info": {
            "description": "Side-scan sonar contacts with verdicts of operators",
            "version": "1",
            "year": created.year,
            "contributor": "sonarpost",
            "url": "",
            "date_created": created.isoformat(timespec="seconds"),
        },
        "licenses": [],
        "images": [_image(number, each, group_of) for number, each in numbered],
        "annotations": [_annotation(number, each) for number, each in numbered],
        "categories": [{"id": number, "name": name, "supercategory": "contact"} for number, name in CATEGORIES.items()],
    }


def _image(number: int, labelled: LabelledImage, group_of: Mapping[str, str]) -> dict[str, object]:
    image, contact = labelled.contact.image, labelled.contact.image.contact
    names = (
        "contact_id",
        "line_name",
        "channel",
        "slant_range_m",
        "ground_range_m",
        "altitude_m",
        "heading_deg",
        "pixel_along_m",
        "pixel_across_m",
        "atd_class",
        "atd_confidence",
        *FURTHER_FIELDS,
    )
    height, width = labelled.pixels.shape
    return {
        "id": number,
        "file_name": labelled.file_name,
        "width": width,
        "height": height,
        "date_captured": utc_text(_seen_utc_s(labelled.contact)),
        "uid": labelled.contact.uid,
        "group": group_of[labelled.contact.uid],
        "vessel_id": image.vessel_id,
        "vehicle_id": image.vehicle_id,
        **{name: getattr(contact, name, None) for name in names},
        "image_version": image.version,
        "codec": image.codec,
        "bytes_received": image.bytes_received,
        "bytes_total": image.bytes_total,
        "missing_fraction": image.missing_fraction,
        "despeckle_strength": image.despeckle_strength,
        "pixels_sha256": image.pixels_sha256,
    }


def _annotation(number: int, labelled: LabelledImage) -> dict[str, object]:
    decision = labelled.decision
    box, is_measured = _box_px(labelled)
    return {
        "id": number,
        "image_id": number,
        "category_id": labelled.category_id,
        "bbox": list(box),
        "area": round(box[2] * box[3], 2),
        "iscrowd": 0,
        "segmentation": [],
        "bbox_is_measured": is_measured,
        "verdict": decision.verdict,
        "mlo_class": decision.mlo_class,
        "operator": decision.operator,
        "operator_confidence": decision.confidence,
        "decided_utc": utc_text(decision.decided_utc_s),
        "decided_version": decision.image_version,
        "disputed": labelled.is_disputed,
        "operators": labelled.operators,
    }


def _box_px(labelled: LabelledImage) -> tuple[tuple[float, float, float, float], bool]:
    """Return the box (x, y, width, height) around the centre, within the image, and whether its size is measured.

    If the size of the contact or of a pixel is not known, the box is the whole image.
    """
    height, width = labelled.pixels.shape
    record = labelled.contact.image.contact
    if record is None or not (record.length_m and record.width_m and record.pixel_along_m and record.pixel_across_m):
        return (0.0, 0.0, float(width), float(height)), False
    across = round(min(record.width_m / record.pixel_across_m, width), 2)
    along = round(min(record.length_m / record.pixel_along_m, height), 2)
    return (round((width - across) / 2, 2), round((height - along) / 2, 2), across, along), True
