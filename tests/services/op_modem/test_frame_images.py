"""Images that an acoustic frame belongs to."""

from __future__ import annotations

import numpy as np
import pytest

from sonarpost.link.auth.authentication import FrameAuthenticator
from sonarpost.link.auth.key import AcousticKey, Direction
from sonarpost.link.config import SenderConfig
from sonarpost.link.downlink.messages import image_of_number
from sonarpost.link.frames.contact_record import ContactSummary
from sonarpost.link.frames.paper.sender import plan_packets
from sonarpost.link.frames.v1.sender import V1Sender
from sonarpost.services.op_modem.frame_images import image_ids_of_frame


def frames(frame_bytes: int, *numbers: int, seal: FrameAuthenticator | None = None) -> list[bytes]:
    sender = V1Sender(SenderConfig(frame_bytes=frame_bytes, group_delay_s=0.0), protection=seal)
    for number in numbers:
        sender.add_image(number, ContactSummary(80, 80), np.random.default_rng(number).bytes(300), 0.0)
    found = []
    while (frame := sender.next_frame(0.0)) is not None:
        found.append(frame)
    return found


@pytest.mark.parametrize("frame_bytes", [64, 256])
def test_frames_with_previews_name_their_images(frame_bytes: int) -> None:
    named = {
        name for frame in frames(frame_bytes, 7, 8, 65535) for name in (image_ids_of_frame(frame) or "").split(",")
    }
    assert named - {""} == {image_of_number(number) for number in (7, 8, 65535)}


def test_frames_of_the_paper_format_name_their_image() -> None:
    for packet in plan_packets("00A7", b"\x01\x02" + bytes(range(80)), ContactSummary(), 3, 64):
        for data in packet:
            assert image_ids_of_frame(data) == "00A7"
    assert image_ids_of_frame(b"\xff\xff") is None


def test_several_images_of_a_frame_are_in_their_order() -> None:
    assert image_ids_of_frame(frames(256, 1, 2, 3)[0]) == "0001,0002,0003"


def test_announced_contact_is_named() -> None:
    sender = V1Sender(SenderConfig(frame_bytes=64, group_delay_s=60.0, announce=True))
    sender.add_image(5, ContactSummary(80, 80), b"a stream of some bytes, and more of it than that", 0.0)
    frame = sender.next_frame(0.0)
    assert frame is not None
    assert image_ids_of_frame(frame) == "0005"


def test_detail_and_message_frames_name_no_image() -> None:
    sender = V1Sender(SenderConfig())
    sender.add_message(b"a message", 0.0)
    message = sender.next_frame(0.0)
    assert message is not None
    assert image_ids_of_frame(message) is None
    assert image_ids_of_frame(frames(64, 1, 2)[-1]) is None


@pytest.mark.parametrize("cut", [0, 1, 5, 20, 63])
def test_damaged_frames_name_no_image(cut: int) -> None:
    frame = frames(64, 9)[0]
    assert image_ids_of_frame(frame[:cut] + bytes([frame[cut] ^ 0x10]) + frame[cut + 1 :]) is None


def test_authenticated_frames_name_no_image() -> None:
    seal = FrameAuthenticator(AcousticKey(bytes(range(32))), 3, Direction.FROM_VEHICLE)
    assert seal.requested_limit is not None
    seal.grant(seal.requested_limit)
    assert image_ids_of_frame(frames(64, 9, seal=seal)[0]) is None
