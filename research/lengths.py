"""`python -m research.lengths`: measured lengths of simulated objects against the truth, by bytes and by axis.

Simulated surveys with the simulator's beam are cut into images of 80 x 140 px around mine-like objects, encoded with
the codec emb and default despeckling, and truncated. A simulated operator draws a line over the brightest part of each
object: both ends are 1.5 px outside the object, because a bright edge looks wider than it is, plus a random error of
1.5 px standard deviation along each axis. The console's own function measures the line.

The length is the axis of a cylinder. Spheres, cones and wedges are about as long as wide: their length is the side that
is closest to the track's direction, and all of that side is insonified. The width is the side perpendicular to it.
"""

import argparse
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import numpy.typing as npt
from scipy.ndimage import map_coordinates

from research.common.command import command_parser, report_progress, run_command
from sonarpost.codec import emb
from sonarpost.codec.emb.codec import EmbCodec
from sonarpost.detection.snippets import to_grey
from sonarpost.extensions.simulation.seabed.objects import ObjectKind
from sonarpost.extensions.simulation.seabed.survey import SurveySpec, TruthObject, simulate_survey
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind
from sonarpost.messages import Contact, Pixels, ReconstructedImage
from sonarpost.review.measurement import Line, measure_line

BYTES: Final = (64, 128, 200)
HEIGHT_PX, WIDTH_PX = 80, 140
OUTSIDE_PX: Final = 1.5
"""How far outside an object the operator sees its end."""
ERROR_PX: Final = 1.5
"""Standard deviation of the operator's ends along each axis."""

_OBJECTS_PER_SURVEY: Final = 10
_SEABEDS: Final = (SeabedKind.SAND, SeabedKind.RIPPLES, SeabedKind.MIXED)
_ROUND_KINDS: Final = (ObjectKind.SPHERE, ObjectKind.TRUNCATED_CONE)

Point = tuple[float, float]
Quantity = Literal["length", "width"]


@dataclass(frozen=True, slots=True)
class KnownObject:
    """An object with its image.

    Attributes:
        truth: The object.
        spec: Specification of its survey.
        altitude_m: Altitude of the vehicle.
        top: Ping of the first row.
        left: Sample of the first column.
        grey: Image before coding, shape (80, 140), uint8.
    """

    truth: TruthObject
    spec: SurveySpec
    altitude_m: float
    top: int
    left: int
    grey: npt.NDArray[np.uint8]

    @property
    def contact(self) -> Contact:
        """Contact record with range, altitude and pixel size."""
        return Contact(
            contact_id="simulated",
            vehicle_id="simulated",
            channel=self.truth.side.value,
            altitude_m=self.altitude_m,
            ground_range_m=self.truth.ground_range_m,
            pixel_along_m=self.spec.ping_spacing_m,
            pixel_across_m=self.spec.sample_m,
        )

    def side(self, quantity: Quantity) -> tuple[float, float]:
        """Return the true length in metres of a side, and its direction in radians from the track to outward."""
        truth = self.truth
        outward = 1.0 if truth.side.value == "starboard" else -1.0
        turn = 0.0 if truth.kind in _ROUND_KINDS else outward * math.radians(truth.orientation_deg)
        long, short = (truth.length_m, turn), (truth.width_m, turn + math.pi / 2)
        if truth.kind is ObjectKind.WEDGE and abs(math.cos(turn)) < abs(math.sin(turn)):
            long, short = short, long
        return long if quantity == "length" else short


def known_objects(count: int, seed: int) -> Iterator[KnownObject]:
    """Yield mine-like objects of simulated surveys: cylinders, truncated cones, spheres and wedges in turn."""
    for survey in range(math.ceil(count / _OBJECTS_PER_SURVEY)):
        spec = SurveySpec(
            seed=1000 * seed + survey,
            pings=900,
            samples=512,
            seabed=_SEABEDS[survey % len(_SEABEDS)],
            targets=min(_OBJECTS_PER_SURVEY, count - survey * _OBJECTS_PER_SURVEY),
            clutter=0,
        )
        simulated = simulate_survey(spec)
        waterfalls = {side: simulated.survey.waterfall(side) for side in simulated.survey.sides()}
        for truth in simulated.truth:
            rows, columns = waterfalls[truth.side].shape
            top = min(max(truth.ping - HEIGHT_PX // 2, 0), rows - HEIGHT_PX)
            left = min(max(truth.sample_index - WIDTH_PX // 3, 0), columns - WIDTH_PX)
            window = waterfalls[truth.side][top : top + HEIGHT_PX, left : left + WIDTH_PX]
            grey = to_grey(window.astype(np.uint32), np.ones(window.shape, dtype=np.bool_))
            altitude_m = simulated.survey.pings[truth.ping].altitude_m
            assert altitude_m is not None  # every simulated ping has one
            yield KnownObject(truth, spec, altitude_m, top, left, grey)


def drawn_line(
    known: KnownObject, image: npt.NDArray[np.uint8], quantity: Quantity, rng: np.random.Generator
) -> tuple[Point, Point]:
    """Return the line that the simulated operator draws over a side of an object."""
    length_m, direction = known.side(quantity)
    ends = []
    for sign in (-1, 1):
        ground_m = known.truth.ground_range_m + sign * length_m / 2 * math.sin(direction)
        slant_m = math.hypot(ground_m, known.altitude_m - known.truth.height_m / 2)
        row = known.truth.ping - known.top + 0.5 + sign * length_m / 2 * math.cos(direction) / known.spec.ping_spacing_m
        ends.append(np.array([row, slant_m / known.spec.sample_m - known.left]))
    length_px = math.hypot(*(ends[1] - ends[0]))
    along = (ends[1] - ends[0]) / length_px
    aside = np.array([-along[1], along[0]])
    # The brightest parallel line within the object: the far side is in the shadow.
    other_m = known.side("width" if quantity == "length" else "length")[0]
    metres = math.hypot(aside[0] * known.spec.ping_spacing_m, aside[1] * known.spec.sample_m)
    shifts = np.arange(-other_m / 2 / metres - 1.0, other_m / 2 / metres + 1.0, 0.5)
    places = ends[0][:, None] + along[:, None] * np.arange(0.0, length_px, 0.5)

    def brightness(shift: float) -> float:
        points = places + aside[:, None] * shift - 0.5
        return float(map_coordinates(image.astype(np.float64), points, order=1, mode="nearest").mean())

    shift = aside * float(max(shifts, key=brightness))
    errors = rng.normal(0.0, ERROR_PX, (2, 2))
    start, end = ends[0] + shift - OUTSIDE_PX * along + errors[0], ends[1] + shift + OUTSIDE_PX * along + errors[1]
    return (float(start[0]), float(start[1])), (float(end[0]), float(end[1]))


@dataclass(frozen=True, slots=True)
class Result:
    """A measured line.

    Attributes:
        bytes_received: Bytes of the image.
        quantity: Length or width.
        is_across: Whether the line is closer to the across-track axis.
        truth_m: True length.
        value_m: Measured length.
        sigma_m: Its stated standard deviation.
        snapped: Number of ends at half brightness.
    """

    bytes_received: int
    quantity: Quantity
    is_across: bool
    truth_m: float
    value_m: float
    sigma_m: float
    snapped: int


def measure(objects: Iterator[KnownObject], sizes: Sequence[int], seed: int) -> list[Result]:
    """Draw and measure the length and the width of each object at each number of bytes."""
    codec = EmbCodec(strength=emb.DEFAULT_STRENGTH)
    rng = np.random.default_rng(seed)
    results: list[Result] = []
    for number, known in enumerate(objects):
        stream = codec.encode(known.grey, max(sizes))
        for size in sizes:
            decoded = codec.decode(stream[:size]).image
            image = _record(known.contact, decoded, min(size, len(stream)))
            for quantity in ("length", "width"):
                start, end = drawn_line(known, decoded, quantity, rng)
                found = measure_line(image, Line(1, "raw", quantity, start, end), known.spec.beam_width_deg)
                truth_m, direction = known.side(quantity)
                value_m, sigma_m, snapped = found["value_m"], found["sigma_m"], found["snapped"]
                assert isinstance(value_m, float)
                assert isinstance(sigma_m, float)
                assert isinstance(snapped, list)
                is_across = abs(math.sin(direction)) > abs(math.cos(direction))
                results.append(Result(size, quantity, is_across, truth_m, value_m, sigma_m, sum(snapped)))
        if number % _OBJECTS_PER_SURVEY == _OBJECTS_PER_SURVEY - 1:
            report_progress(f"{number + 1} objects")
    return results


def _record(contact: Contact, decoded: npt.NDArray[np.uint8], size: int) -> ReconstructedImage:
    pixels = Pixels.from_array(decoded)
    return ReconstructedImage(
        vessel_id="simulated",
        vehicle_id="simulated",
        image_id="0000",
        version=1,
        contact=contact,
        codec="emb",
        model="",
        pixels=pixels,
        pixels_sha256=pixels.sha256,
        complete=True,
        missing_fraction=0.0,
        missing_mask=b"",
        missing_halves=(),
        bytes_received=size,
        bytes_total=size,
        frames_received=1,
        first_frame_utc_s=0.0,
        last_frame_utc_s=0.0,
    )


@dataclass(frozen=True, slots=True)
class Summary:
    """Errors of a group of results: fractions within 1 and 2 standard deviations, and mean relative error."""

    count: int
    within_1: float
    within_2: float
    bias: float
    snapped: float


def summarise(results: Sequence[Result]) -> Summary:
    """Summarise at least one result."""
    errors = np.array([one.value_m - one.truth_m for one in results])
    ratios = np.abs(errors) / np.array([one.sigma_m for one in results])
    return Summary(
        count=len(results),
        within_1=float(np.mean(ratios <= 1)),
        within_2=float(np.mean(ratios <= 2)),
        bias=float(np.mean(errors / np.array([one.truth_m for one in results]))),
        snapped=float(np.mean([one.snapped / 2 for one in results])),
    )


def new_parser() -> argparse.ArgumentParser:
    """Return the parser of this command."""
    parser = command_parser("lengths", "Measured lengths of simulated objects against the truth.")
    parser.add_argument("--objects", type=int, default=200, metavar="N", help="objects (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="seed of all random draws (default: %(default)s)")
    return parser


def run(args: argparse.Namespace) -> int:
    """Print the table."""
    results = measure(known_objects(args.objects, args.seed), BYTES, args.seed)
    print("quantity  bytes  axis     lines   1 sigma    2 sigma    bias  ends snapped")
    for quantity in ("length", "width"):
        for size in BYTES:
            lines = [one for one in results if (one.quantity, one.bytes_received) == (quantity, size)]
            groups = {
                "both": lines,
                "along": [one for one in lines if not one.is_across],
                "across": [one for one in lines if one.is_across],
            }
            for axis, group in groups.items():
                if group:
                    row = summarise(group)
                    print(
                        f"{quantity:8s}  {size:5d}  {axis:6s}  {row.count:6d}  {row.within_1:10.0%}"
                        f"  {row.within_2:10.0%}  {row.bias:+6.1%}  {row.snapped:12.0%}"
                    )
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command."""
    return run_command(new_parser(), run, arguments)


if __name__ == "__main__":
    sys.exit(main())
