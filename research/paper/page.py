"""The page that lays this package's figures beside the paper's, as Markdown."""

from __future__ import annotations

from collections.abc import Sequence

from research.paper.dimensions import DISTANCE_ABOVE, FOM_BELOW, TILE_PX, DimensionPoint
from research.paper.figures import HEIGHT_PX, PIXELS, WIDTH_PX, Reproduced

_HEAD = """# The paper's figures, measured again

`python -m research.paper` writes this page and its pictures; every number below is of one run of that command. The
paper is "Transmission of images through the underwater acoustic channel to submerged networks". Its pictures are of a
Klein 5500 and were not published, so dB are not comparable from picture to picture: what can be compared is the order
of the codecs, the sizes, and the trends. Times are of one core (`OMP_NUM_THREADS=1`).
"""


def page(
    origin: str,
    pictures: int,
    table2: Sequence[Reproduced],
    fig2: Sequence[Reproduced],
    fig3: Sequence[DimensionPoint],
    training: int,
    test: int,
) -> str:
    """Return the page.

    Args:
        origin: What the pictures of Table II and Fig. 2 are of.
        pictures: How many there are for Table II; the first of them is Fig. 2's.
        table2: Table II, measured again.
        fig2: Fig. 2, measured again on one picture.
        fig3: Fig. 3, measured again.
        training: Pictures Fig. 3's databases were built from.
        test: Pictures they were tested on.
    """
    return "\n".join(
        [
            _HEAD,
            "## Table II: four codecs",
            "",
            _TABLE2_NOTE.format(pictures=pictures, origin=origin),
            "",
            *_reproduced_table(table2),
            "",
            _VQ_NOTE,
            "",
            "## Fig. 2: one picture",
            "",
            f"One picture of the same kind. {_MAXLOOP_NOTE}",
            "",
            *_reproduced_table(fig2),
            "",
            *_order_note(fig2),
            "![Fig. 2 again](reproduction/fig2.png)",
            "",
            "## Fig. 3: how many principal components",
            "",
            _FIG3_NOTE.format(training=training, test=test),
            "",
            *_dimension_table(fig3),
            "",
            "![Fig. 3 again](reproduction/fig3.png)",
            "",
            *_claims(fig3),
            "",
        ]
    )


_TABLE2_NOTE = (
    f"Means over {{pictures}} pictures of {HEIGHT_PX} x {WIDTH_PX} px ({PIXELS} B): {{origin}}. Each codec may use as "
    "many bytes as the paper's ratio leaves for such a picture (vq takes what it takes); bytes are whole streams, "
    "header included."
)
_FIG3_NOTE = (
    f"Databases of {TILE_PX} x {TILE_PX} px tiles built by Table IV (figure of merit below {FOM_BELOW:g}, distance "
    f"above {DISTANCE_ABOVE:g}) from {{training}} simulated pictures, search wholly in the rotated space as in the "
    "paper, tested on {test} others."
)
_VQ_NOTE = (
    "The paper leaves edge pixels that fill no tile unsent (10 tiles of 20 x 20 px in this picture, 44 of 10 x 10 px) "
    "and has no header. Here the whole picture is sent, 18 and 60 tiles at 14 bits, behind 7 bytes that say codec, "
    "codebook and size, so a stream is longer and says what it is."
)
_MAXLOOP_NOTE = (
    "The paper bounds SPIHT by the number of its passes (maxloop); here by the bytes that those passes took there."
)


def _reproduced_table(rows: Sequence[Reproduced]) -> list[str]:
    lines = [
        "| codec | paper: bytes, ratio | paper: PSNR | here: bytes, ratio | here: PSNR / SSIM | emb, as many bytes |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        paper = f"{row.figure.paper_bytes} B, {PIXELS / row.figure.paper_bytes:.1f}:1"
        start = f"| {row.figure.title} | {paper} | {row.figure.paper_psnr:.2f} dB "
        if row.sent_bytes is None or row.psnr is None or row.ssim is None:
            lines.append(f"{start}| - | not measured: {row.reason} | - |")
            continue
        flagship = "-" if row.flagship_psnr is None else f"{row.flagship_psnr:.2f} dB"
        lines.append(
            f"{start}| {row.sent_bytes:.0f} B, {PIXELS / row.sent_bytes:.1f}:1 "
            f"| {row.psnr:.2f} dB / {row.ssim:.3f} | {flagship} |"
        )
    return lines


def _order_note(rows: Sequence[Reproduced]) -> list[str]:
    """Hold the paper's most surprising pair, JPEG 2000 far above SPIHT at half the bytes, to this run's figures."""
    found = {row.figure.title: row for row in rows}
    jpeg, spiht = found["JPEG 2000"], found["SPIHT, maxloop 7"]
    if jpeg.psnr is None or spiht.psnr is None:
        return []
    note = (
        f"In the paper JPEG 2000 is {jpeg.figure.paper_psnr - spiht.figure.paper_psnr:.2f} dB better than SPIHT with "
        f"{jpeg.figure.paper_bytes / spiht.figure.paper_bytes:.0%} of its bytes; here, at the same two sizes, the "
        f"difference is {jpeg.psnr - spiht.psnr:.2f} dB. Both code the coefficients of a wavelet, so a gap like the "
        "paper's is more likely one of its two implementations than of the methods."
    )
    return [note, ""]


def _dimension_table(points: Sequence[DimensionPoint]) -> list[str]:
    lines = [
        "| dimensions | build, s | encode, ms | rotation matrix, kB | database, MB | tiles | FOM | PSNR, dB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {p.dims} | {p.build_s:.2f} | {p.encode_ms:.2f} | {p.rotation_bytes / 1e3:.0f} "
        f"| {p.database_bytes / 1e6:.2f} | {p.tiles} | {p.fom:.2f} | {p.psnr:.2f} |"
        for p in points
    ]
    return lines


def _claims(points: Sequence[DimensionPoint]) -> list[str]:
    """Hold what the paper says about its Fig. 3 to the figures of this run."""
    first, last = points[0], points[-1]
    span = max(p.fom for p in points) - min(p.fom for p in points)
    grown = [
        ("time to build the database", first.build_s, last.build_s, "s"),
        ("time to encode a picture", first.encode_ms, last.encode_ms, "ms"),
        ("size of the rotation matrix", first.rotation_bytes / 1e3, last.rotation_bytes / 1e3, "kB"),
        ("size of the database", first.database_bytes / 1e6, last.database_bytes / 1e6, "MB"),
    ]
    lines = [
        f"The paper: with more dimensions these grow (from {first.dims} to {last.dims} dimensions here):",
        "",
    ]
    lines += [
        f"* {what}: {before:.2f} {unit} to {after:.2f} {unit}, {'confirmed' if after > before else 'not seen here'};"
        for what, before, after, unit in grown
    ]
    quality = (
        f'"No significant difference in the FOM": over all dimensions it spans {span:.2f} of 100 here; PSNR goes from '
        f"{first.psnr:.2f} to {last.psnr:.2f} dB. With few dimensions less of a tile's distance is seen, so fewer "
        f"tiles come to lie beyond the threshold: the database itself is smaller ({first.tiles} tiles against "
        f"{last.tiles})."
    )
    return [*lines, "", quality]
