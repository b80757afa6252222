"""Records in the c2 service's folder, for the tests of exports."""

import io
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from builders.records import decision_record, reconstructed_image
from sonarpost.archive.image_files import write_image
from sonarpost.archive.shore_files import decision_path
from sonarpost.export.contacts import ContactSet, ExportContact, ImageSideCar, side_car
from sonarpost.export.formats import exporters
from sonarpost.export.live import LiveContacts
from sonarpost.export.source import ExportSource, StoredImages
from sonarpost.messages import Contact, Decision, Pixels, ReconstructedImage

FIRST_UTC_S = 1476262801.25
HOSTILE = st.text(
    st.one_of(st.characters(), st.sampled_from("<>&\"'=\x00\x08\x1b\x7f\x85\u2028\ufffe\ufdd0]]>%$[name]")), max_size=60
).filter(lambda text: not any("\ud800" <= c <= "\udfff" for c in text))
"""Text that no format may take for its own syntax."""


def image(image_id: str = "00A7", contact: dict[str, Any] | None = None, **changes: Any) -> ReconstructedImage:
    pixels = np.arange(16 * 24, dtype=np.uint16).astype(np.uint8).reshape(16, 24)
    packed = changes.pop("pixels", None) or Pixels.from_array(pixels)
    vehicle_id = changes.get("vehicle_id", "uuv-1")
    known = {
        "lat_deg": 41.52513339,
        "lon_deg": -70.67124561,
        "position_sigma_m": 4.5,
        "time_utc_s": 1476262790.5,
        "depth_m": 12.25,
        "altitude_m": 3.5,
        "heading_deg": 30.0,
        "channel": "starboard",
        "ground_range_m": 20.5,
        "atd_confidence": 1.75,
        "pixel_along_m": 0.25,
        "pixel_across_m": 0.125,
    }
    record = Contact(contact_id=f"{vehicle_id}/{image_id}", vehicle_id=vehicle_id, **(known | (contact or {})))
    fields: dict[str, Any] = {
        "vehicle_id": vehicle_id,
        "image_id": image_id,
        "contact": record,
        "model": "1f" * 32,
        "bytes_received": 232,
        "bytes_total": 232,
        "frames_received": 6,
        "first_frame_utc_s": FIRST_UTC_S,
        "last_frame_utc_s": FIRST_UTC_S + 30,
    }
    return reconstructed_image(packed, **(fields | changes))


def contact_of(image_id: str = "00A7", vessel_id: str = "vessel-1", **fields: Any) -> ExportContact:
    """Return the live contact of an image."""
    found = LiveContacts().add(image(image_id, fields, vessel_id=vessel_id))
    assert found is not None
    return found


class Clock:
    """A clock that a test sets."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def decision(image_id: str = "00A7", **changes: Any) -> Decision:
    fields = {"image_id": image_id, "operator": "A. Operator", "decided_utc_s": FIRST_UTC_S + 600}
    return decision_record(**{"decision_id": "d-1", **fields, **changes})


def store(out_dir: Path, *records: ReconstructedImage | Decision) -> Path:
    """Write records into a folder as c2 does; `test_c2_files_are_readable` compares both."""
    for record in records:
        folder = out_dir / record.vessel_id
        if isinstance(record, ReconstructedImage):
            write_image(folder, record)
            continue
        path = decision_path(out_dir, record.vessel_id, record.decision_id)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(record.model_dump(), indent=1) + "\n")
    return out_dir


def mission(out_dir: Path) -> Path:
    """Write one contact of each kind; the golden files show them."""
    return store(
        out_dir,
        image("0001"),
        image("0002", {"lat_deg": 41.5261}, version=2, notes=("a note",)),
        decision("0002", decision_id="d-2", mlo_class="moored mine", confidence=0.8, remark='=1+1 <b>& "both"</b>'),
        image("0003", {"lat_deg": 41.5271, "channel": "port"}),
        decision("0003", decision_id="d-3a", verdict="mine_like"),
        decision("0003", decision_id="d-3b", verdict="not_mine_like", decided_utc_s=FIRST_UTC_S + 700),
        image("0004", {"lat_deg": 41.5281, "heading_deg": None}, missing_fraction=0.25, complete=False),
        decision("0004", decision_id="d-4", verdict="unsure", operator="B. Operator"),
        image("0005", {"lat_deg": None, "lon_deg": None, "position_sigma_m": None}),
        image("0006", {"lat_deg": 41.5291}, codec="", model="", complete=False, missing_fraction=1.0),
    )


def authenticated_mission(out_dir: Path) -> Path:
    """Write an authenticated contact, and one whose frames had no authentication."""
    return store(out_dir, image("0001", authenticated=True), image("0002", {"lat_deg": 41.5261}, authenticated=False))


def classified_mission(out_dir: Path) -> Path:
    """Write a contact of each class of the detector, and one with probabilities alone."""
    return store(
        out_dir,
        image("0001", {"atd_class": "mine_like", "p_mine_like": 0.85, "p_other_object": 0.1}, authenticated=True),
        image("0002", {"lat_deg": 41.5261, "atd_class": "clutter", "p_mine_like": 0.0, "p_other_object": 1.0}),
        image("0003", {"lat_deg": 41.5271, "atd_class": "structure"}),
        image("0004", {"lat_deg": 41.5281, "p_mine_like": 0.5, "p_other_object": 0.25}),
    )


def reviewed_mission(out_dir: Path) -> Path:
    """Write a contact whose decision is withdrawn, a disputed one, and one whose dispute has a decision."""
    later = {"decided_utc_s": FIRST_UTC_S + 700}
    return store(
        out_dir,
        image("0001"),
        decision("0001", decision_id="d-1", operator="anna"),
        decision("0001", decision_id="d-2", operator="anna", verdict="unsure", withdraws="d-1", **later),
        image("0002", {"lat_deg": 41.5261}),
        decision("0002", decision_id="d-3", operator="anna", mlo_class="manta"),
        decision("0002", decision_id="d-4", operator="ben", verdict="not_mine_like", **later),
        image("0003", {"lat_deg": 41.5271}),
        decision("0003", decision_id="d-5", operator="anna"),
        decision("0003", decision_id="d-6", operator="ben", verdict="not_mine_like", overrules=("d-5",), **later),
    )


MISSIONS = {
    "mission": mission,
    "authenticated": authenticated_mission,
    "classified": classified_mission,
    "reviewed": reviewed_mission,
}


def single(record: ReconstructedImage, *decisions: Decision) -> ContactSet:
    """One contact without files."""
    side = ImageSideCar.model_validate_json(json.dumps(side_car(record)))
    return ContactSet((ExportContact(side, decisions, None),), (), ())


def export(name: str, contacts: ContactSet, images: StoredImages | None = None) -> bytes:
    """Return the contacts in a format."""
    file = io.BytesIO()
    path = Path(tempfile.gettempdir()) / f"contacts.{name}"
    exporters().get(name).write(file, ExportSource(contacts, images or StoredImages(), path))
    return file.getvalue()


def golden_files(name: str, contacts: ContactSet) -> dict[str, bytes]:
    """Return all text exports of a mission by the name of their golden file."""
    return {
        f"{name}.geojson": export("geojson", contacts),
        f"{name}.kml": export("kml", contacts),
        f"{name}.csv": export("csv", contacts),
    }
