"""What the demo shows at its end: the contact sheet, the table, the summary."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

from rich.console import Console
from rich.table import Table

from sonarpost.cli.demo.account import Result
from sonarpost.cli.demo.settings import ChainSettings
from sonarpost.cli.demo.sheet import SheetRow, write_sheet
from sonarpost.cli.demo.watch import Watcher
from sonarpost.codec.interface import DecodedImage
from sonarpost.codec.registry import CodecResources, default_registry
from sonarpost.codec.vq.codebook import open_codebook
from sonarpost.messages import EncodedImage, ReconstructedImage

_COLUMNS: tuple[tuple[str, Literal["left", "right"]], ...] = (
    ("image", "left"),
    ("ping", "right"),
    ("conf.", "right"),
    ("position ashore", "left"),
    ("bytes", "right"),
    ("vessel", "left"),
    ("shore", "left"),
)


def show(watcher: Watcher, settings: ChainSettings, result: Result, console: Console) -> None:
    """Write the sheet into the demo's folder, print table and summary."""
    sheet = settings.folder / "demo.png"
    write_sheet(sheet, _title(settings, result), _rows(watcher, settings))
    _print_table(watcher, settings, console)
    _print_summary(result, sheet, console)


def _as_sent(image: EncodedImage, settings: ChainSettings) -> DecodedImage:
    """Decode the stream as it left the vehicle, nothing lost."""
    resources = CodecResources(open_codebook(settings.codebook).tiles)
    return default_registry().create_for_stream(image.stream, resources).decode(image.stream)


def _rows(watcher: Watcher, settings: ChainSettings) -> list[SheetRow]:
    rows = []
    for image_id, image in watcher.encoded.items():
        size = f"{image.height_px} x {image.width_px} px in {len(image.stream)} B"
        snippet = watcher.snippets.get(image.contact.contact_id)
        vessel, shore = watcher.vessel.get(image_id), watcher.shore.get(image_id)
        got = [
            (None, None)
            if received is None or not received.codec
            else (received.picture.to_array(), received.missing())
            for received in (vessel, shore)
        ]
        rows.append(
            SheetRow(
                title=f"{image_id}  {image.contact.contact_id}",
                detail=f"{_position(watcher, image_id, image)}   confidence {_confidence(image)}   "
                f"{size}   {_completeness(watcher.shore.get(image_id))}",
                pictures=(
                    snippet.picture.to_array() if snippet else None,
                    _as_sent(image, settings).image,
                    got[0][0],
                    got[1][0],
                ),
                missing=(None, None, got[0][1], got[1][1]),
            )
        )
    return rows


def _confidence(image: EncodedImage) -> str:
    return "-" if image.contact.atd_confidence is None else f"{image.contact.atd_confidence:.2f}"


def _position(watcher: Watcher, image_id: str, image: EncodedImage) -> str:
    """Return the position as the shore knows it."""
    if image.contact.lat_deg is None:
        return "no fix"
    received = watcher.shore.get(image_id)
    contact = received.contact if received else None
    if contact is None or contact.lat_deg is None or contact.lon_deg is None:
        return "position not received"
    return f"{contact.lat_deg:.6f} {contact.lon_deg:.6f}"


def _completeness(received: ReconstructedImage | None) -> str:
    if received is None:
        return "not received"
    if received.complete:
        return "complete"
    if received.codec and not received.missing_fraction:
        return f"coarse: {received.bytes_received} B so far"
    halves = f" ({' and '.join(received.missing_halves)} half)" if received.missing_halves else ""
    return f"{100 * received.missing_fraction:.0f} % missing{halves}"


def _title(settings: ChainSettings, result: Result) -> str:
    return (
        f"sonarpost: {result.images_shore} of {result.contacts} pictures ashore, rate {settings.rate}, "
        f"frame loss {settings.loss:g}, {result.acoustic_s:.0f} s in the water"
    )


def _print_table(watcher: Watcher, settings: ChainSettings, console: Console) -> None:
    table = Table(title=f"pictures sent at rate {settings.rate}")
    for heading, justify in _COLUMNS:
        table.add_column(heading, justify=justify, no_wrap=True)
    for image_id, image in watcher.encoded.items():
        contact = image.contact
        vessel, shore = watcher.vessel.get(image_id), watcher.shore.get(image_id)
        same = vessel is not None and shore is not None and vessel.picture_sha256 == shore.picture_sha256
        table.add_row(
            image_id,
            "-" if contact.ping_number is None else f"{contact.ping_number} {(contact.channel or '-')[:4]}",
            _confidence(image),
            _position(watcher, image_id, image),
            str(len(image.stream)),
            "-" if vessel is None else _on_the_vessel(vessel),
            "same" if same else "-" if shore is None else "other",
        )
    console.print(table)


def _on_the_vessel(received: ReconstructedImage) -> str:
    if received.complete:
        return "complete"
    if received.codec and not received.missing_fraction:
        return f"{received.bytes_received} B"
    return f"{100 * received.missing_fraction:.0f} % lost"


def _print_summary(result: Result, sheet: Path, console: Console) -> None:
    console.print(
        f"{result.contacts} contacts, {result.frames_sent} frames sent, {result.frames_lost} lost, "
        f"{result.images_vessel} pictures on the vessel, {result.images_shore} ashore "
        f"({result.images_complete} complete), "
        f"{'identical' if result.sha256_match else '[red]not identical[/red]'}; "
        f"{result.acoustic_s:.0f} s in the water, {result.elapsed_s:.0f} s here"
    )
    if result.missing_ashore:
        console.print(f"[red]let through by the water but not ashore: {', '.join(result.missing_ashore)}")
    print(f"contact sheet: {sheet}", file=sys.stderr)
