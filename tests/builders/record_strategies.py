"""Hypothesis strategies for all records, from the types and limits of their fields, with all values of the wire."""

import hashlib
from functools import cache
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from hypothesis import strategies as st
from pydantic.fields import FieldInfo

from builders.record_samples import RECORD_TYPES
from sonarpost.archive.image_parts import whole_part
from sonarpost.messages import (
    CodedImage,
    Command,
    Contact,
    ImagePart,
    Pixels,
    ReceivedImage,
    ReceivedStatus,
    ReconstructedImage,
    Record,
    Transmission,
    VehicleStatus,
)
from sonarpost.messages.acoustic import MAX_TRANSMISSION_S

_LIMITS = ("ge", "gt", "le", "lt", "min_length", "max_length", "pattern")


def _of_type(kind: Any, metadata: tuple[Any, ...] = ()) -> st.SearchStrategy[Any]:
    """Return the strategy of a field's type with the limits that pydantic has for it."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        inner = (limit for more in parts[1:] for limit in (more.metadata if isinstance(more, FieldInfo) else [more]))
        return _of_type(parts[0], (*metadata, *inner))
    if origin in (Union, UnionType):
        return st.one_of(*(_of_type(part, () if part is NoneType else metadata) for part in reversed(parts)))
    if origin is Literal:
        return st.sampled_from(parts)
    if origin is tuple and parts[-1] is not ...:
        return st.tuples(*(_of_type(part) for part in parts))
    if origin is dict:
        return st.dictionaries(*(_of_type(part) for part in parts), max_size=4)
    limit = {name: getattr(each, name) for each in metadata for name in _LIMITS if hasattr(each, name)}
    return _limited(origin or kind, parts, limit)


def _limited(kind: Any, parts: tuple[Any, ...], limit: dict[str, Any]) -> st.SearchStrategy[Any]:
    sizes = {"min_size": limit.get("min_length", 0), "max_size": min(limit.get("max_length", 60), 60)}
    found: st.SearchStrategy[Any]
    if kind is tuple:
        found = st.lists(_of_type(parts[0]), max_size=3).map(tuple)
    elif kind is float:
        ends = {"exclude_min": "gt" in limit, "exclude_max": "lt" in limit, "allow_nan": False, "allow_infinity": False}
        found = st.floats(limit.get("ge", limit.get("gt")), limit.get("le", limit.get("lt")), **ends)
    elif kind is int:
        found = st.integers(limit.get("ge"), limit.get("le"))
    elif kind is bytes:
        found = st.binary(**sizes)
    elif kind is str and "pattern" in limit:
        found = st.from_regex(limit["pattern"].removeprefix("^").removesuffix("$"), fullmatch=True)
    elif kind is str:  # UTF-8 cannot encode surrogates
        found = st.text(st.characters(exclude_categories=("Cs",)), **sizes)
    else:
        found = st.deferred(lambda: STRATEGIES[kind]) if kind in RECORD_TYPES else st.from_type(kind)
    return found


@cache
def _field(record_type: type[Record], name: str) -> st.SearchStrategy[Any]:
    info = record_type.model_fields[name]
    return _of_type(info.annotation, tuple(info.metadata))


def _fields(record_type: type[Record], *without: str) -> st.SearchStrategy[dict[str, Any]]:
    names = [name for name in record_type.model_fields if name not in without]
    return st.fixed_dictionaries({name: _field(record_type, name) for name in names})


def _maybe(strategy: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.none() | strategy


@st.composite
def _contacts(draw: st.DrawFn) -> Contact:
    """Draw a contact with or without probabilities."""
    fields = draw(_fields(Contact, "p_other_object"))
    known = st.sampled_from(["mine_like", "clutter", "structure"])
    atd_class, p_mine_like = draw(known | _field(Contact, "atd_class")), fields["p_mine_like"]
    p_other_object = None if p_mine_like is None else draw(st.floats(0, 1 - p_mine_like))
    return Contact(**fields | {"atd_class": atd_class, "p_other_object": p_other_object})


@st.composite
def pixels(draw: st.DrawFn) -> Pixels:
    height_px, width_px, bits = draw(st.integers(1, 12)), draw(st.integers(1, 12)), draw(st.sampled_from([8, 16]))
    size = height_px * width_px * bits // 8
    return Pixels(height_px=height_px, width_px=width_px, bits=bits, data=draw(st.binary(min_size=size, max_size=size)))


@st.composite
def images(draw: st.DrawFn) -> ReconstructedImage:
    fields = draw(_fields(ReconstructedImage, "pixels_sha256", "missing_mask"))
    pixels = fields["pixels"]
    size = (pixels.height_px * pixels.width_px + 7) // 8
    mask = draw(st.just(b"") | st.binary(min_size=size, max_size=size))
    digest = hashlib.sha256(pixels.data).hexdigest()
    return ReconstructedImage(**fields, pixels_sha256=digest, missing_mask=mask)


@st.composite
def _received(draw: st.DrawFn, record_type: type[ReceivedImage] = ReceivedImage) -> Any:
    fields = draw(_fields(record_type, "stream", "missing", "missing_halves"))
    stream = draw(st.binary(max_size=64))
    bounds = sorted(draw(st.sets(st.integers(0, len(stream)), max_size=6)))
    missing = tuple(zip(bounds[::2], bounds[1::2], strict=False))
    halves = draw(st.sampled_from([(), ("top",), ("bottom",), ("top", "bottom")]))
    return record_type(**fields, stream=stream, missing=missing, missing_halves=halves)


def coded_images() -> st.SearchStrategy[CodedImage]:
    return _received(CodedImage)


@st.composite
def _parts(draw: st.DrawFn) -> ImagePart:
    whole = whole_part(draw(coded_images()))
    base = draw(st.integers(0, whole.n - 1))
    return whole.model_copy(update={"b": base, "k": draw(st.integers(0, 2**32 - 1)) if base else None})


@st.composite
def _commands(draw: st.DrawFn) -> Command:
    fields = draw(_fields(Command, "box"))
    box = st.tuples(st.integers(0, 15), st.integers(0, 15), st.integers(16, 32), st.integers(16, 32))
    fields["box"] = draw(_maybe(box))
    needed = {"revisit": ("lat_deg", "lon_deg"), "region": ("image_id", "box", "stream_bytes")}
    needed["prioritise"] = ("image_id", "place")
    values = {name: _field(Command, name) for name in fields} | {"box": box}
    for name in needed.get(fields["kind"], ("image_id",)):
        if fields[name] is None:
            fields[name] = draw(values[name].filter(lambda value: value is not None))
    return Command(**fields)


@st.composite
def _transmissions(draw: st.DrawFn) -> Transmission:
    start_utc_s = draw(st.floats(0, 4e9))
    return Transmission(start_utc_s=start_utc_s, end_utc_s=start_utc_s + draw(st.floats(0, MAX_TRANSMISSION_S - 1)))


STRATEGIES: dict[type[Record], st.SearchStrategy[Any]] = {
    **{t: st.builds(t.model_validate, _fields(t)) for t in RECORD_TYPES},
    Contact: _contacts(),
    Pixels: pixels(),
    ReceivedImage: _received(),
    CodedImage: coded_images(),
    ImagePart: _parts(),
    ReconstructedImage: images(),
    Command: _commands(),
    Transmission: _transmissions(),
    VehicleStatus: st.builds(
        lambda fields, lon_deg: VehicleStatus(**fields, lon_deg=None if fields["lat_deg"] is None else lon_deg),
        _fields(VehicleStatus, "lon_deg"),
        st.floats(-180, 180),
    ),
    ReceivedStatus: st.builds(
        lambda fields: ReceivedStatus(**fields, vehicle_id=fields["status"].vehicle_id),
        _fields(ReceivedStatus, "vehicle_id"),
    ),
}

any_record: st.SearchStrategy[Record] = st.one_of(*STRATEGIES.values())
