"""What the demo shows at its end: the contact sheet, the table, the summary."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.table import Table

from sonarpost.codec import decode_image, get_codec
from sonarpost.codec.interface import Image, to_uint8
from sonarpost.codec.quality import psnr_db
from sonarpost.extensions.simulation.demo.next_steps import shown
from sonarpost.extensions.simulation.demo.outcome import Outcome
from sonarpost.extensions.simulation.demo.settings import ChainSettings
from sonarpost.extensions.simulation.demo.sheet import SheetCell, SheetContact, write_sheet
from sonarpost.extensions.simulation.demo.watch import Watcher
from sonarpost.messages import EncodedImage, ReconstructedImage

_COLUMNS: tuple[tuple[str, Literal["left", "right"]], ...] = (
    ("image", "left"),
    ("ping", "right"),
    ("conf.", "right"),
    ("position at the shore", "left"),
    ("bytes", "right"),
    ("vessel", "left"),
    ("shore", "left"),
)
_PAPER_CODEBOOKS = ("nominal-10", "nominal-20")


def show(watcher: Watcher, settings: ChainSettings, outcome: Outcome, console: Console) -> None:
    """Write the sheet into the demo's folder; print the table and the summary."""
    sheet = settings.folder / "demo.png"
    third = "as sent, before losses" if settings.link == "paper" else "the paper's codec, same number of bytes"
    stages = ("original", "received at the shore site", third)
    title = f"sonarpost: {outcome.images_complete} of {outcome.contacts} images complete at the shore site"
    write_sheet(sheet, title, _subtitle(settings, outcome), stages, _sheet_contacts(watcher, settings))
    _print_table(watcher, settings, console)
    _print_summary(outcome, sheet, console)


def _sheet_contacts(watcher: Watcher, settings: ChainSettings) -> list[SheetContact]:
    """Return the images, the highest confidence first."""
    by_confidence = sorted(watcher.encoded.items(), key=lambda one: -(one[1].contact.atd_confidence or 0.0))
    contacts = []
    for image_id, encoded in by_confidence:
        snippet, received = watcher.snippets.get(encoded.contact.contact_id), watcher.shore.get(image_id)
        original = None if snippet is None else to_uint8(snippet.pixels.to_array())
        size = f"{encoded.width_px} x {encoded.height_px} px"  # the font of the sheet has no multiplication sign
        raw = f"{size}, {encoded.height_px * encoded.width_px} B"
        place = f"{_position(watcher, image_id, encoded)}   confidence {_confidence(encoded)}"
        contacts.append(
            SheetContact(
                title=f"{image_id}  {encoded.contact.contact_id}",
                detail=f"{place}   {_state(received)}",
                cells=(
                    SheetCell(raw, original),
                    _received_cell(received, original),
                    _as_sent_cell(encoded) if settings.link == "paper" else _paper_cell(original, len(encoded.stream)),
                ),
            )
        )
    return contacts


def _received_cell(received: ReconstructedImage | None, original: Image | None) -> SheetCell:
    if received is None or not received.codec:
        return SheetCell()
    image = received.pixels.to_array()
    label = f"{received.codec}, {received.bytes_received} B"
    if received.despeckle_strength:
        label += f", despeckled, strength {received.despeckle_strength:.2f}"
    else:
        label += _psnr(original, to_uint8(image))
    return SheetCell(label, image, received.missing())


def _as_sent_cell(encoded: EncodedImage) -> SheetCell:
    return SheetCell(f"{len(encoded.stream)} B", decode_image(encoded.stream).image)


def _paper_cell(original: Image | None, budget_bytes: int) -> SheetCell:
    """Return what the paper's codec makes of at most as many bytes: 10-pixel tiles, else 20-pixel tiles."""
    if original is None:
        return SheetCell()
    for name in _PAPER_CODEBOOKS:
        stream = get_codec("vq", codebook=name).encode(original)
        if len(stream) <= budget_bytes:
            break
    image = decode_image(stream).image
    return SheetCell(f"vq, {len(stream)} B", image)


def _psnr(original: Image | None, image: Image) -> str:
    """Return the PSNR; it says nothing about a despeckled image, as the original has the speckle."""
    return "" if original is None or original.shape != image.shape else f", PSNR {psnr_db(original, image):.1f} dB"


def _confidence(image: EncodedImage) -> str:
    return "-" if image.contact.atd_confidence is None else f"{image.contact.atd_confidence:.2f}"


def _position(watcher: Watcher, image_id: str, image: EncodedImage) -> str:
    """Return the position that the shore site received."""
    if image.contact.lat_deg is None:
        return "no fix"
    received = watcher.shore.get(image_id)
    contact = received.contact if received else None
    if contact is None or contact.lat_deg is None or contact.lon_deg is None:
        return "position not received"
    return f"{contact.lat_deg:.6f} {contact.lon_deg:.6f}"


def _state(received: ReconstructedImage | None) -> str:
    if received is None:
        return "not received"
    if received.complete:
        return "complete"
    if not received.codec:
        return "contact record only"
    if not received.missing_fraction:
        return f"{received.bytes_received} of {received.bytes_total} B"
    return f"{100 * received.missing_fraction:.0f} % missing"


def _subtitle(settings: ChainSettings, outcome: Outcome) -> str:
    method = "the paper's codec and link" if settings.link == "paper" else "codec emb, link v1"
    losses = f"{outcome.frames_lost} of {outcome.frames_sent} frames lost"
    return f"{method}, modem rate {settings.rate}, {losses}, {outcome.acoustic_s:.0f} s of acoustic airtime"


def _print_table(watcher: Watcher, settings: ChainSettings, console: Console) -> None:
    table = Table(title=f"images sent at rate {settings.rate}")
    for heading, justify in _COLUMNS:
        table.add_column(heading, justify=justify, no_wrap=True)
    for image_id, image in watcher.encoded.items():
        contact = image.contact
        vessel, shore = watcher.vessel.get(image_id), watcher.shore.get(image_id)
        same = vessel is not None and shore is not None and vessel.pixels_sha256 == shore.pixels_sha256
        state = _state(vessel)
        table.add_row(
            image_id,
            "-" if contact.ping_number is None else f"{contact.ping_number} {(contact.channel or '-')[:4]}",
            _confidence(image),
            _position(watcher, image_id, image),
            str(len(image.stream)),
            state if state == "complete" else f"[red]{state}",
            "same" if same else "[red]not received" if shore is None else "[red]older version",
        )
    console.print(table)


def _print_summary(outcome: Outcome, sheet: Path, console: Console) -> None:
    same = "identical at both" if outcome.sha256_match else "[red]not identical[/red]"
    for line in (
        f"{outcome.contacts} contacts",
        f"images received: {outcome.images_vessel} at the vessel, {outcome.images_shore} at the shore site",
        f"{outcome.images_complete} images complete at the shore site; files {same}",
        f"{outcome.frames_sent} acoustic frames sent, {outcome.frames_lost} lost",
        f"{outcome.acoustic_s:.0f} s of air time, {outcome.elapsed_s:.0f} s in real time",
        'acoustic link: unauthenticated (emulated channel, acoustic_auth = "none")',
    ):
        console.print(line, highlight=False, soft_wrap=True)
    for text, names in (
        ("contacts without an encoded image", outcome.not_sent),
        ("images missing at the shore site", outcome.missing),
        ("images incomplete at the shore site", outcome.incomplete),
    ):
        if names:
            console.print(f"[red]FAILED: {len(names)} {text}: {', '.join(names)}")
    console.print(f"contact sheet: {shown(sheet)}", highlight=False, markup=False, soft_wrap=True)
