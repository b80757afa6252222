"""One example of every record: what the tests of the wire share, and golden vectors are made of."""

from __future__ import annotations

from sonarpost.messages import (
    AcousticFrame,
    Advice,
    Command,
    Contact,
    Decision,
    DownlinkState,
    EncodedImage,
    Health,
    LinkQuality,
    OutgoingMessage,
    Pixels,
    QueuedImage,
    QueueState,
    ReceivedMessage,
    ReconstructedImage,
    Record,
    Relayed,
    Snippet,
    TaskingState,
)

BARE_CONTACT = Contact(contact_id="c1", vehicle_id="uuv-1")

FULL_CONTACT = Contact(
    contact_id="line-7-ab12cd34-0412-port-377",
    vehicle_id="uuv-1",
    sonar_id="Marine Sonic 600 kHz",
    line_name="line-7",
    ping_number=412,
    channel="port",
    time_utc_s=1476262800.25,
    lat_deg=41.5251,
    lon_deg=-70.6712,
    position_sigma_m=4.5,
    depth_m=12.25,
    altitude_m=3.5,
    heading_deg=271.5,
    speed_mps=1.5,
    slant_range_m=21.0,
    ground_range_m=20.5,
    atd_class="sphere",
    atd_confidence=1.75,
    length_m=1.25,
    width_m=0.5,
    shadow_m=2.75,
    height_m=0.375,
    pixel_along_m=0.0625,
    pixel_across_m=0.03125,
)

RASTER_8 = Pixels(height_px=2, width_px=3, bits=8, data=bytes([0, 1, 2, 127, 128, 255]))
RASTER_16 = Pixels(height_px=1, width_px=2, bits=16, data=b"\x01\x00\xff\xfe")

QUALITY = LinkQuality(
    snr_in_db=11.5, snr_out_db=9.25, spl_db=132.0, mse_db=-9.75, doppler=-0.125, frames=3, bad_frames=1
)

COMPLETE_IMAGE = ReconstructedImage(
    vessel_id="vessel-1",
    vehicle_id="uuv-1",
    image_id="00A7",
    version=1,
    contact=FULL_CONTACT,
    codec="vq",
    model="1f" * 32,
    picture=RASTER_8,
    picture_sha256=RASTER_8.sha256,
    complete=True,
    missing_fraction=0.0,
    missing_mask=b"",
    missing_halves=(),
    bytes_received=232,
    bytes_total=232,
    frames_received=6,
    first_frame_utc_s=1476262801.0,
    last_frame_utc_s=1476262833.5,
    notes=(),
)

DAMAGED_IMAGE = ReconstructedImage(
    **COMPLETE_IMAGE.model_dump(
        include={"vessel_id", "vehicle_id", "image_id", "codec", "model", "first_frame_utc_s", "last_frame_utc_s"}
    ),
    version=2,
    contact=None,
    picture=RASTER_8,
    picture_sha256=RASTER_8.sha256,
    complete=False,
    missing_fraction=0.5,
    missing_mask=b"\xa8",
    missing_halves=("top", "bottom"),
    bytes_received=100,
    bytes_total=232,
    frames_received=2,
    notes=("1 frames disagreed with others of this image",),
)

PREVIEW_GONE = QueuedImage(
    image_id="00A7", contact_id="c1", bytes_left=448, preview_utc_s=None, expected_utc_s=1476262900.5
)
NOTHING_GONE = QueuedImage(
    image_id="00A8", contact_id="c2", bytes_left=640, preview_utc_s=1476262850.0, expected_utc_s=1476263000.0
)

SAMPLES: dict[str, Record] = {
    "outgoing-message": OutgoingMessage(
        message_id="status-17",
        source="autonomy",
        priority=3,
        lifetime_s=600.0,
        created_utc_s=1476262800.25,
        data=b"\x01\x02battery 80",
    ),
    "received-message": ReceivedMessage(
        vessel_id="vessel-1", vehicle_id="uuv-1", received_utc_s=1476262830.5, data=b"\x01\x02battery 80"
    ),
    "downlink-state-asked": DownlinkState(
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        kind="decision",
        record_id="d-2016-10-12-1",
        state="asked",
        times_sent=0,
        expires_utc_s=1476284500.0,
        changed_utc_s=1476262903.0,
    ),
    "downlink-state-refused": DownlinkState(
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        kind="refine",
        record_id="c-1",
        state="refused",
        times_sent=2,
        expires_utc_s=1476284500.0,
        changed_utc_s=1476262963.0,
        reason="unknown image",
    ),
    "queued-image-nothing-gone": NOTHING_GONE,
    "queued-image": PREVIEW_GONE,
    "queue-state": QueueState(
        platform_id="uuv-1",
        time_utc_s=1476262801.0,
        rate=1,
        frame_loss=0.25,
        packet_interval_s=6.5,
        messages_waiting=2,
        message_bytes=40,
        images_waiting=2,
        images=(PREVIEW_GONE, NOTHING_GONE),
    ),
    "queue-state-empty": QueueState(
        platform_id="uuv-1",
        time_utc_s=1476262801.0,
        rate=4,
        frame_loss=None,
        packet_interval_s=3.5,
        messages_waiting=0,
        message_bytes=0,
        images_waiting=0,
        images=(),
    ),
    "contact-full": FULL_CONTACT,
    "contact-bare": BARE_CONTACT,
    "raster-8-bits": RASTER_8,
    "raster-16-bits": RASTER_16,
    "snippet-wide": Snippet(contact=FULL_CONTACT, picture=RASTER_16, source="line-7.xtf", wide=RASTER_8),
    "snippet-without-wide": Snippet(contact=FULL_CONTACT, picture=RASTER_16, source="line-7.xtf"),
    "encoded-image": EncodedImage(
        vehicle_id="uuv-1",
        image_id="00A7",
        contact=BARE_CONTACT,
        codec="vq",
        model="1f" * 32,
        height_px=80,
        width_px=140,
        stream=bytes(range(16)),
        original_sha256="e0" * 32,
    ),
    "link-quality-full": QUALITY,
    "link-quality-bare": LinkQuality(),
    "acoustic-frame-received": AcousticFrame(
        direction="rx",
        platform_id="vessel-1",
        time_utc_s=1476262801.5,
        source=3,
        destination=1,
        rate=1,
        packet=17,
        frame_number=2,
        frame_count=3,
        data=b"00A7\x00\x01\x02\x03",
        quality=QUALITY,
    ),
    "acoustic-frame-of-unknown-rate": AcousticFrame(
        direction="tx",
        platform_id="uuv-1",
        time_utc_s=0.0,
        source=3,
        destination=127,
        rate=None,
        packet=0,
        frame_number=1,
        frame_count=None,
        data=b"",
    ),
    "reconstructed-image-complete": COMPLETE_IMAGE,
    "reconstructed-image-damaged": DAMAGED_IMAGE,
    "decision-full": Decision(
        decision_id="d-1",
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        image_id="00A7",
        image_version=2,
        verdict="mine_like",
        confidence=0.75,
        mlo_class="cylinder",
        remark="shadow länger als das Echo",
        operator="op",
        decided_utc_s=1476262900.0,
    ),
    "decision-bare": Decision(
        decision_id="d-2",
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        image_id="0001",
        image_version=1,
        verdict="unsure",
        operator="op",
        decided_utc_s=0.0,
    ),
    "command-refine": Command(
        command_id="c-1",
        kind="refine",
        vehicle_id="uuv-1",
        image_id="00A7",
        issued_by="op",
        issued_utc_s=1476262901.0,
    ),
    "command-revisit": Command(
        command_id="c-2",
        kind="revisit",
        vehicle_id="uuv-1",
        lat_deg=41.5251,
        lon_deg=-70.6712,
        issued_by="op",
        issued_utc_s=1476262902.0,
    ),
    "command-wider": Command(
        command_id="c-3",
        kind="wider",
        vehicle_id="uuv-1",
        image_id="00A7",
        issued_by="op",
        issued_utc_s=1476262903.0,
    ),
    "advice-full": Advice(
        advice_id="a-2016-10-12-1",
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        image_id="00A7",
        image_version=2,
        verdict="mine_like",
        confidence=0.875,
        mlo_class="sphere",
        remark="the shadow has a clean edge — look again from the east",
        author="expert",
        advised_utc_s=1476263000.5,
    ),
    "advice-bare": Advice(
        advice_id="a-2",
        vessel_id="vessel-1",
        vehicle_id="uuv-1",
        image_id="0001",
        image_version=1,
        author="expert",
        advised_utc_s=0.0,
    ),
    "tasking-state-waiting": TaskingState(
        vessel_id="vessel-1", kind="advice", record_id="a-2", state="waiting", changed_utc_s=1476263001.0
    ),
    "tasking-state-refused": TaskingState(
        vessel_id="vessel-1",
        kind="command",
        record_id="c-9",
        state="refused",
        reason="sonarpost/v1/vessel-1/command/refine: no consumer",
        changed_utc_s=1476263002.0,
    ),
    "relayed": Relayed(
        vessel_id="vessel-1",
        key="sonarpost/v1/vessel-1/contact/decision",
        payload=b"\x80",
        relayed_utc_s=1476262903.0,
    ),
    "health": Health(
        platform_id="uuv-1",
        service="compressor",
        time_utc_s=1476262904.0,
        started_utc_s=1476262800.0,
        state="degraded",
        detail="no space left",
        counters={"records_handled": 12, "records_refused": 1},
        gauges={"inbox": 0.0, "outbox": 3.0},
    ),
}

RECORD_TYPES: tuple[type[Record], ...] = tuple(
    sorted({type(sample) for sample in SAMPLES.values()}, key=lambda t: t.TYPE)
)
