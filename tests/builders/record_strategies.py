"""Hypothesis strategies for all records, with all values that the wire can hold."""

from __future__ import annotations

import hashlib
import string
from typing import Any, get_args

from hypothesis import strategies as st

from sonarpost.archive.image_parts import whole_part
from sonarpost.messages import (
    MIN_REGION_BYTES,
    AcousticFrame,
    Advice,
    CodedImage,
    Command,
    CommandKind,
    Contact,
    Decision,
    DownlinkKind,
    DownlinkState,
    EncodedImage,
    Health,
    ImagePart,
    LinkQuality,
    OutgoingMessage,
    Pixels,
    QueuedImage,
    QueuePlace,
    QueueState,
    ReceivedImage,
    ReceivedMessage,
    ReceivedStatus,
    ReconstructedImage,
    Record,
    Relayed,
    Snippet,
    TaskingState,
    Transmission,
    Transmissions,
    VehicleRange,
    VehicleStatus,
)

_LOWER = string.ascii_lowercase + string.digits


def _real(low: float, high: float, **more: bool) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False, allow_infinity=False, **more)


def _maybe(strategy: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.none() | strategy


def _text(low: int, high: int) -> st.SearchStrategy[str]:
    # UTF-8 cannot encode surrogates.
    return st.text(st.characters(exclude_categories=("Cs",)), min_size=low, max_size=min(high, 60))


_name = st.builds(lambda a, b: a + b, st.sampled_from(_LOWER), st.text(_LOWER + "-", max_size=31))
_image_id = st.text(string.digits + string.ascii_uppercase, min_size=4, max_size=4)
_sha256 = st.text("0123456789abcdef", min_size=64, max_size=64)
_model = st.just("") | _sha256
_time = _real(0, 253402300799)
_metres = _maybe(_real(0, 20000))
_count = st.integers(0, 2**63 - 1)
_ordinal = st.integers(1, 2**63 - 1)
_record_id = st.text([chr(code) for code in range(0x21, 0x7F)], min_size=1, max_size=64)
_lat, _lon = _real(-90, 90), _real(-180, 180)
_finite = st.floats(allow_nan=False, allow_infinity=False)

_contacts = st.builds(
    Contact,
    contact_id=_text(1, 120),
    vehicle_id=_name,
    sonar_id=_maybe(_text(0, 2000)),
    line_name=_maybe(_text(0, 2000)),
    ping_number=_maybe(_count),
    channel=st.sampled_from([None, "port", "starboard"]),
    time_utc_s=_maybe(_time),
    lat_deg=_maybe(_lat),
    lon_deg=_maybe(_lon),
    position_sigma_m=_metres,
    depth_m=_maybe(_real(-100, 12000)),
    altitude_m=_metres,
    heading_deg=_maybe(_real(0, 360, exclude_max=True)),
    speed_mps=_maybe(_real(-50, 50)),
    slant_range_m=_metres,
    ground_range_m=_metres,
    atd_class=st.sampled_from(["mine-like", "clutter", "structure"]) | _maybe(_text(0, 60)),
    atd_confidence=_maybe(_real(0, 2)),
    length_m=_metres,
    width_m=_metres,
    shadow_m=_metres,
    height_m=_metres,
    pixel_along_m=_maybe(_real(0, 100, exclude_min=True)),
    pixel_across_m=_maybe(_real(0, 100, exclude_min=True)),
)


@st.composite
def _classified_contacts(draw: st.DrawFn) -> Contact:
    """Draw a contact with or without probabilities."""
    p_mine_like = draw(_maybe(_real(0, 1)))
    p_other_object = None if p_mine_like is None else draw(_real(0, 1 - p_mine_like))
    return Contact(**draw(_contacts).model_dump() | {"p_mine_like": p_mine_like, "p_other_object": p_other_object})


contacts = _classified_contacts()


@st.composite
def pixels(draw: st.DrawFn) -> Pixels:
    height_px, width_px, bits = draw(st.integers(1, 12)), draw(st.integers(1, 12)), draw(st.sampled_from([8, 16]))
    size = height_px * width_px * bits // 8
    return Pixels(height_px=height_px, width_px=width_px, bits=bits, data=draw(st.binary(min_size=size, max_size=size)))


qualities = st.builds(
    LinkQuality,
    snr_in_db=_maybe(_finite),
    snr_out_db=_maybe(_finite),
    spl_db=_maybe(_finite),
    mse_db=_maybe(_finite),
    doppler=_maybe(_finite),
    frames=_maybe(_count),
    bad_frames=_maybe(_count),
)


@st.composite
def images(draw: st.DrawFn) -> ReconstructedImage:
    picture = draw(pixels())
    size = (picture.height_px * picture.width_px + 7) // 8
    return ReconstructedImage(
        vessel_id=draw(_name),
        vehicle_id=draw(_name),
        image_id=draw(_image_id),
        version=draw(_ordinal),
        contact=draw(_maybe(contacts)),
        codec=draw(_text(0, 40)),
        model=draw(_model),
        picture=picture,
        picture_sha256=hashlib.sha256(picture.data).hexdigest(),
        complete=draw(st.booleans()),
        missing_fraction=draw(_real(0, 1)),
        missing_mask=draw(st.just(b"") | st.binary(min_size=size, max_size=size)),
        missing_halves=draw(st.sampled_from([(), ("top",), ("bottom",), ("top", "bottom")])),
        bytes_received=draw(_count),
        bytes_total=draw(_count),
        frames_received=draw(_count),
        first_frame_utc_s=draw(_time),
        last_frame_utc_s=draw(_time),
        notes=tuple(draw(st.lists(_text(0, 2000), max_size=3))),
        authenticated=draw(_maybe(st.booleans())),
        despeckle_strength=draw(_maybe(_real(0, 1))),
    )


@st.composite
def coded_images(draw: st.DrawFn) -> CodedImage:
    fields = dict(draw(received_images()))
    model = draw(st.binary(min_size=16, max_size=16) | st.just(b"")).hex()
    crc32 = draw(_maybe(st.integers(0, 2**32 - 1)))
    return CodedImage(**fields, codec=draw(_text(0, 40)), model=model, picture_crc32=crc32)


@st.composite
def image_parts(draw: st.DrawFn) -> ImagePart:
    whole = whole_part(draw(coded_images()))
    base = draw(st.integers(0, whole.n - 1))
    return whole.model_copy(update={"b": base, "k": draw(st.integers(0, 2**32 - 1)) if base else None})


@st.composite
def received_images(draw: st.DrawFn) -> ReceivedImage:
    stream = draw(st.binary(max_size=64))
    bounds = sorted(draw(st.sets(st.integers(0, len(stream)), max_size=6)))
    return ReceivedImage(
        vessel_id=draw(_name),
        vehicle_id=draw(_name),
        image_id=draw(_image_id),
        version=draw(_ordinal),
        contact=draw(_maybe(contacts)),
        height_px=draw(_maybe(st.integers(1, 4096))),
        width_px=draw(_maybe(st.integers(1, 4096))),
        stream=stream,
        missing=tuple(zip(bounds[::2], bounds[1::2], strict=False)),
        missing_halves=draw(st.sampled_from([(), ("top",), ("bottom",), ("top", "bottom")])),
        complete=draw(st.booleans()),
        bytes_received=draw(_count),
        bytes_total=draw(_count),
        frames_received=draw(_count),
        conflicts=draw(_count),
        first_frame_utc_s=draw(_time),
        last_frame_utc_s=draw(_time),
        authenticated=draw(_maybe(st.booleans())),
    )


_box = st.tuples(st.integers(0, 15), st.integers(0, 15), st.integers(16, 32), st.integers(16, 32))
_region_bytes = st.integers(MIN_REGION_BYTES, 65535)
_place = st.sampled_from(get_args(QueuePlace))


@st.composite
def commands(draw: st.DrawFn) -> Command:
    kind = draw(st.sampled_from(get_args(CommandKind)))
    place = kind == "revisit"
    return Command(
        command_id=draw(_record_id),
        kind=kind,
        vehicle_id=draw(_name),
        image_id=draw(_maybe(_image_id) if place else _image_id),
        lat_deg=draw(_lat if place else _maybe(_lat)),
        lon_deg=draw(_lon if place else _maybe(_lon)),
        issued_by=draw(_text(1, 120)),
        issued_utc_s=draw(_time),
        box=draw(_box if kind == "region" else _maybe(_box)),
        stream_bytes=draw(_region_bytes if kind == "region" else _maybe(_region_bytes)),
        place=draw(_place if kind == "prioritise" else _maybe(_place)),
    )


STRATEGIES: dict[type[Record], st.SearchStrategy[Any]] = {
    Contact: contacts,
    Pixels: pixels(),
    ReceivedImage: received_images(),
    CodedImage: coded_images(),
    ImagePart: image_parts(),
    Snippet: st.builds(Snippet, contact=contacts, picture=pixels(), source=_text(0, 2000), wide=_maybe(pixels())),
    EncodedImage: st.builds(
        EncodedImage,
        vehicle_id=_name,
        image_id=_image_id,
        contact=contacts,
        codec=_text(1, 40),
        model=_model,
        height_px=st.integers(1, 4096),
        width_px=st.integers(1, 4096),
        stream=st.binary(min_size=8, max_size=300),
        original_sha256=_sha256,
    ),
    LinkQuality: qualities,
    AcousticFrame: st.builds(
        AcousticFrame,
        direction=st.sampled_from(["tx", "rx"]),
        platform_id=_name,
        time_utc_s=_time,
        source=st.integers(0, 127),
        destination=st.integers(0, 127),
        rate=_maybe(st.integers(0, 6)),
        packet=_count,
        frame_number=st.integers(1, 8),
        frame_count=_maybe(st.integers(0, 8)),
        data=st.binary(max_size=256),
        quality=_maybe(qualities),
    ),
    ReconstructedImage: images(),
    Decision: st.builds(
        Decision,
        decision_id=_record_id,
        vessel_id=_name,
        vehicle_id=_name,
        image_id=_image_id,
        image_version=_ordinal,
        verdict=st.sampled_from(["mine_like", "not_mine_like", "unsure"]),
        confidence=_maybe(_real(0, 1)),
        mlo_class=_maybe(_text(0, 60)),
        remark=_text(0, 2000),
        operator=_text(1, 120),
        decided_utc_s=_time,
        withdraws=_maybe(_record_id),
        overrules=st.lists(_record_id, max_size=16).map(tuple),
    ),
    Advice: st.builds(
        Advice,
        advice_id=_record_id,
        vessel_id=_name,
        vehicle_id=_name,
        image_id=_image_id,
        image_version=_ordinal,
        verdict=st.sampled_from([None, "mine_like", "not_mine_like", "unsure"]),
        confidence=_maybe(_real(0, 1)),
        mlo_class=_maybe(_text(0, 60)),
        remark=_text(0, 2000),
        author=_text(1, 120),
        advised_utc_s=_time,
    ),
    TaskingState: st.builds(
        TaskingState,
        vessel_id=_name,
        kind=st.sampled_from(["advice", "command"]),
        record_id=_record_id,
        state=st.sampled_from(["waiting", "delivered", "refused"]),
        reason=_text(0, 2000),
        changed_utc_s=_time,
    ),
    Command: commands(),
    Relayed: st.builds(
        Relayed, vessel_id=_name, key=_text(1, 300), payload=st.binary(max_size=200), relayed_utc_s=_time
    ),
    Health: st.builds(
        Health,
        platform_id=_name,
        service=_text(1, 40),
        time_utc_s=_time,
        started_utc_s=_time,
        state=st.sampled_from(["starting", "ok", "degraded", "stopping"]),
        detail=_text(0, 2000),
        counters=st.dictionaries(_text(0, 40), _count, max_size=4),
        gauges=st.dictionaries(_text(0, 40), _finite, max_size=4),
    ),
}

STRATEGIES[OutgoingMessage] = st.builds(
    OutgoingMessage,
    message_id=_record_id,
    source=_text(1, 40),
    priority=st.integers(1, 7),
    lifetime_s=_real(0, 604800, exclude_min=True),
    created_utc_s=_time,
    data=st.binary(min_size=1, max_size=100),
)
STRATEGIES[ReceivedMessage] = st.builds(
    ReceivedMessage,
    vessel_id=_name,
    vehicle_id=_name,
    received_utc_s=_time,
    data=st.binary(min_size=1, max_size=100),
)
STRATEGIES[DownlinkState] = st.builds(
    DownlinkState,
    vessel_id=_name,
    vehicle_id=_name,
    kind=st.sampled_from(get_args(DownlinkKind)),
    record_id=_record_id,
    state=st.sampled_from(["asked", "sent", "confirmed", "refused", "expired"]),
    times_sent=_count,
    expires_utc_s=_time,
    changed_utc_s=_time,
    reason=_text(0, 2000),
)
STRATEGIES[QueuedImage] = st.builds(
    QueuedImage,
    image_id=_image_id,
    contact_id=_text(1, 120),
    bytes_left=_count,
    preview_utc_s=_maybe(_time),
    expected_utc_s=_time,
)
STRATEGIES[QueueState] = st.builds(
    QueueState,
    platform_id=_name,
    time_utc_s=_time,
    rate=st.integers(0, 6),
    frame_loss=_maybe(_real(0, 1)),
    packet_interval_s=_real(0, 86400),
    messages_waiting=_count,
    message_bytes=_count,
    images_waiting=_count,
    images=st.lists(STRATEGIES[QueuedImage], max_size=3).map(tuple),
    images_accepted=_maybe(_count),
)
STRATEGIES[Transmission] = st.builds(
    lambda start_utc_s, length_s: Transmission(start_utc_s=start_utc_s, end_utc_s=start_utc_s + length_s),
    start_utc_s=_real(0, 4e9),
    length_s=_real(0, 299),
)
STRATEGIES[Transmissions] = st.builds(
    Transmissions,
    platform_id=_name,
    time_utc_s=_time,
    transmissions=st.lists(STRATEGIES[Transmission], max_size=3).map(tuple),
)
STRATEGIES[VehicleStatus] = st.builds(
    lambda position, **fields: VehicleStatus(
        lat_deg=position and position[0], lon_deg=position and position[1], **fields
    ),
    position=_maybe(st.tuples(_real(-90, 90), _real(-180, 180))),
    vehicle_id=_name,
    time_utc_s=_time,
    heading_deg=_maybe(_real(0, 359)),
    speed_mps=_maybe(_real(-50, 50)),
    depth_m=_maybe(_real(-100, 12000)),
    altitude_m=_maybe(_real(0, 20000)),
    swath_m=_maybe(_real(0, 20000)),
    battery=_maybe(_real(0, 1)),
    images_waiting=_maybe(_count),
    disk_free_bytes=_maybe(_count),
)
STRATEGIES[ReceivedStatus] = st.builds(
    lambda status, **fields: ReceivedStatus(status=status, vehicle_id=status.vehicle_id, **fields),
    status=STRATEGIES[VehicleStatus],
    vessel_id=_name,
    received_utc_s=_time,
    authenticated=st.booleans(),
)
STRATEGIES[VehicleRange] = st.builds(
    VehicleRange,
    vessel_id=_name,
    vehicle_id=_name,
    measured_utc_s=_time,
    travel_s=_real(0, 100),
    sound_speed_mps=_real(1300, 1700),
    distance_m=_real(0, 170_000),
)

any_record: st.SearchStrategy[Record] = st.one_of(*STRATEGIES.values())
