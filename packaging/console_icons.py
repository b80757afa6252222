"""Draw the PNG icons of the console's web manifest, as in `icon.svg`: `python packaging/console_icons.py`."""

from pathlib import Path

from PIL import Image, ImageDraw

STATIC = Path(__file__).parents[1] / "services" / "console" / "static"
UNITS = 32
"""Side of the drawing, as in the SVG file."""
OVERSAMPLING = 4
BLUE, WHITE = "#0b5cad", "#ffffff"
ARCS = (((23, 23), 14), ((23, 23), 8))
"""Centre and radius of the quarter circles, which open to the upper left."""
LINE, DOT = 2.6, ((22, 22), 2.6)


def icon(side_px: int) -> Image.Image:
    """Return the icon with a side of `side_px`."""
    scale = OVERSAMPLING * side_px / UNITS
    image = Image.new("RGB", (OVERSAMPLING * side_px,) * 2, BLUE)
    draw = ImageDraw.Draw(image)

    def circle(centre: tuple[float, float], radius: float) -> tuple[float, float, float, float]:
        return tuple(scale * (c + sign * radius) for sign in (-1, 1) for c in centre)  # type: ignore[return-value]

    for (x, y), radius in ARCS:
        draw.arc(circle((x, y), radius + LINE / 2), 180, 270, WHITE, round(scale * LINE))
        for end in ((x - radius, y), (x, y - radius)):
            draw.ellipse(circle(end, LINE / 2), WHITE)
    draw.ellipse(circle(*DOT), WHITE)
    return image.resize((side_px, side_px), Image.Resampling.LANCZOS)


if __name__ == "__main__":
    for side_px in (192, 512):
        icon(side_px).save(STATIC / f"icon-{side_px}.png", optimize=True)
