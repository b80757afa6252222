"""What the demo shows at its end: the table, the summary, and the contact sheet."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image as Canvas
from PIL import ImageDraw, ImageFont
from rich.console import Console
from rich.table import Table

from sonarpost.codec import decode_image, get_codec
from sonarpost.codec.interface import Image, to_uint8
from sonarpost.extensions.simulation.demo.outcome import Outcome
from sonarpost.extensions.simulation.demo.settings import ChainSettings
from sonarpost.extensions.simulation.demo.watch import Watcher
from sonarpost.messages import EncodedImage, ReconstructedImage

_COLUMNS = {
    "image": "",
    "ping": ">",
    "conf.": ">",
    "position at the shore": "",
    "bytes": ">",
    "vessel": "",
    "shore": "",
}
"""Headings of the table; `>` aligns to the right."""
BACKGROUND, INK, FAINT, MISSING = (16, 20, 26), (232, 236, 240), (140, 150, 160), (200, 70, 60)
SCALE, MAX_SCALED_PX = 2, 256
"""Images of at most 256 px are drawn at twice their size; larger ones would make the sheet unreadable on a screen."""
MARGIN, GAP, GROUP_GAP, LABEL, CAPTION, HEADER = 24, 12, 40, 24, 56, 104
MAX_CONTACTS, CONTACTS_A_LINE = 12, 2


@dataclass(frozen=True)
class SheetCell:
    """One image of a contact, its label, and its pixels without data, which are hatched; no image: nothing received."""

    label: str = ""
    image: Image | npt.NDArray[np.uint16] | None = None
    missing: npt.NDArray[np.bool_] | None = None


@dataclass(frozen=True)
class SheetContact:
    """One contact: a cell for each stage, and two lines of text below them."""

    title: str
    detail: str
    cells: tuple[SheetCell, ...]


def show(watcher: Watcher, settings: ChainSettings, outcome: Outcome, console: Console) -> None:
    """Write the sheet into the demo's folder; print the table and the summary."""
    is_paper = settings.link == "paper"
    third = "as sent, before losses" if is_paper else "the paper's codec, same number of bytes"
    stages = ("original", "received at the shore site", third)
    title = f"sonarpost: {outcome.images_complete} of {outcome.contacts} images complete at the shore site"
    method = "the paper's codec and link" if is_paper else "codec emb, link v1"
    losses = f"{outcome.frames_lost} of {outcome.frames_sent} frames lost"
    airtime = f"{outcome.acoustic_s:.0f} s of acoustic airtime"
    by_confidence = sorted(watcher.encoded.items(), key=lambda one: -(one[1].contact.atd_confidence or 0.0))
    contacts = [_sheet_contact(watcher, image_id, encoded, is_paper=is_paper) for image_id, encoded in by_confidence]
    subtitle = f"{method}, modem rate {settings.rate}, {losses}, {airtime}"
    write_sheet(settings.folder / "demo.png", title, subtitle, stages, contacts)
    _print_table(watcher, settings, console)
    _print_summary(outcome, settings.folder / "demo.png", console)


def shown(path: Path) -> str:
    """Return a path, relative if it is in the current folder."""
    path = path.absolute()
    return str(path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path)


def _psnr_db(original: Image, decoded: Image) -> float:
    mean_square = float(np.mean((original.astype(np.float64) - decoded) ** 2))
    return float(10.0 * np.log10(255.0**2 / mean_square)) if mean_square else float("inf")


def _sheet_contact(watcher: Watcher, image_id: str, encoded: EncodedImage, *, is_paper: bool) -> SheetContact:
    snippet, received = watcher.snippets.get(encoded.contact.contact_id), watcher.shore.get(image_id)
    original = None if snippet is None else to_uint8(snippet.pixels.to_array())
    size = f"{encoded.width_px} x {encoded.height_px} px"  # the font of the sheet has no multiplication sign
    at_shore, third = SheetCell(), SheetCell()
    if received is not None and received.codec:
        image = received.pixels.to_array()
        label = f"{received.codec}, {received.bytes_received} B"
        if received.despeckle_strength:  # the PSNR says nothing: the original has the speckle
            label += f", despeckled, strength {received.despeckle_strength:.2f}"
        elif original is not None and original.shape == image.shape:
            label += f", PSNR {_psnr_db(original, to_uint8(image)):.1f} dB"
        at_shore = SheetCell(label, image, received.missing())
    if is_paper:
        third = SheetCell(f"{len(encoded.stream)} B", decode_image(encoded.stream).image)
    elif original is not None:
        # What the paper's codec makes of at most as many bytes: 10-pixel tiles, else 20-pixel tiles.
        stream = get_codec("vq", codebook="nominal-10").encode(original)
        if len(stream) > len(encoded.stream):
            stream = get_codec("vq", codebook="nominal-20").encode(original)
        third = SheetCell(f"vq, {len(stream)} B", decode_image(stream).image)
    raw = SheetCell(f"{size}, {encoded.height_px * encoded.width_px} B", original)
    place = f"{_position(received, encoded)}   confidence {_confidence(encoded)}   {_state(received)}"
    return SheetContact(f"{image_id}  {encoded.contact.contact_id}", place, (raw, at_shore, third))


def _confidence(image: EncodedImage) -> str:
    return "-" if image.contact.atd_confidence is None else f"{image.contact.atd_confidence:.2f}"


def _position(received: ReconstructedImage | None, image: EncodedImage) -> str:
    """Return the position that the shore site received."""
    if image.contact.lat_deg is None:
        return "no fix"
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


def _print_table(watcher: Watcher, settings: ChainSettings, console: Console) -> None:
    table = Table(title=f"images sent at rate {settings.rate}")
    for heading, justify in _COLUMNS.items():
        table.add_column(heading, justify="right" if justify else "left", no_wrap=True)
    for image_id, image in watcher.encoded.items():
        contact = image.contact
        vessel, shore = watcher.vessel.get(image_id), watcher.shore.get(image_id)
        same = vessel is not None and shore is not None and vessel.pixels_sha256 == shore.pixels_sha256
        state = _state(vessel)
        table.add_row(
            image_id,
            "-" if contact.ping_number is None else f"{contact.ping_number} {(contact.channel or '-')[:4]}",
            _confidence(image),
            _position(shore, image),
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
        *outcome.failures,
    ):
        console.print(line, highlight=False, soft_wrap=True)
    console.print(f"contact sheet: {shown(sheet)}", highlight=False, markup=False, soft_wrap=True)


def write_sheet(path: Path, title: str, subtitle: str, stages: Sequence[str], contacts: Sequence[SheetContact]) -> None:
    """Write the sheet as PNG: the first 12 contacts, two side by side.

    Args:
        path: Where to write.
        title: First line.
        subtitle: Second line.
        stages: Heading of each cell of a contact.
        contacts: Contacts, the most interesting first.
    """
    drawn = contacts[:MAX_CONTACTS]
    sizes = [[_drawn_px(cell.image) for cell in contact.cells if cell.image is not None] for contact in drawn]
    width_px = max((width for group in sizes for width, _ in group), default=140 * SCALE)
    heights_px = [max((height for _, height in group), default=80 * SCALE) for group in sizes]
    group_px = len(stages) * (width_px + GAP) - GAP + GROUP_GAP
    groups = min(CONTACTS_A_LINE, max(1, len(drawn)))
    lines_px = [max(heights_px[i : i + groups]) for i in range(0, len(drawn), groups)]
    more = f"and {len(contacts) - len(drawn)} more in the folders beside this sheet" if contacts[MAX_CONTACTS:] else ""
    total_height = HEADER + sum(px + LABEL + CAPTION for px in lines_px) + MARGIN
    sheet = Canvas.new("RGB", (2 * MARGIN + groups * group_px - GROUP_GAP, total_height), BACKGROUND)
    draw = ImageDraw.Draw(sheet)

    def write(x: int, y: int, text: str, colour: tuple[int, int, int], size: int) -> None:
        draw.text((x, y), text, fill=colour, font=ImageFont.load_default(size))

    write(MARGIN, 14, title, INK, 20)
    write(MARGIN, 44, f"{subtitle}   {more}", FAINT, 15)
    for number, contact in enumerate(drawn):
        line, group = divmod(number, groups)
        left, height_px = MARGIN + group * group_px, lines_px[line]
        top = HEADER + sum(px + LABEL + CAPTION for px in lines_px[:line])
        below = top + height_px
        for stage, (name, cell) in enumerate(zip(stages, contact.cells, strict=True)):
            x = left + stage * (width_px + GAP)
            if line == 0:
                write(x, 76, name, INK, 15)
            if cell.image is None:
                draw.rectangle((x, top, x + width_px - 1, below - 1), outline=MISSING)
                write(x + 12, top + 12, "nothing received", MISSING, 14)
            else:
                sheet.paste(_drawn(cell.image, cell.missing), (x, top))
            write(x, below + 4, cell.label, INK, 13)
        write(left, below + LABEL, contact.title, INK, 14)
        write(left, below + LABEL + 18, contact.detail, FAINT, 13)
    sheet.save(path)


def _drawn(image: Image | npt.NDArray[np.uint16], missing: npt.NDArray[np.bool_] | None) -> Canvas.Image:
    colour = np.repeat(to_uint8(image)[:, :, None], 3, axis=2)
    if missing is not None and missing.any():
        # Hatched: plain black could pass for a shadow.
        rows, columns = np.indices(missing.shape)
        colour[missing & ((rows + columns) % 8 == 0)] = MISSING
    return Canvas.fromarray(colour).resize(_drawn_px(image), Canvas.Resampling.NEAREST)


def _drawn_px(image: Image | npt.NDArray[np.uint16]) -> tuple[int, int]:
    """Return width and height on the sheet."""
    scale = SCALE if max(image.shape) <= MAX_SCALED_PX else 1
    return image.shape[1] * scale, image.shape[0] * scale
