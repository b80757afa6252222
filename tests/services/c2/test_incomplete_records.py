"""Records that a vessel begins and never completes do not prevent others from delivering theirs."""

import hashlib

import pytest
from builders.common import eventually
from builders.records import reconstructed_image
from builders.shore import relayed
from builders.small_disk import SmallDisk

from sonarpost import keys
from sonarpost.delivery.protocol import CHUNK_BYTES, AckReply, attachment
from sonarpost.delivery.records import OutboxItem
from sonarpost.messages import Pixels
from sonarpost.services.c2.config import C2Config
from sonarpost.services.c2.service import C2Service

SIZE = 8 * 1024 * 1024


@pytest.fixture
def small_disk(tmp_path):
    disk = SmallDisk(tmp_path / "disk", 48_000)
    yield disk
    disk.close()


def begin_records(session, vessel, count):
    """Send all chunks but the last of `count` records of 8 MiB, without regard to the replies."""
    key = keys.shore_inbox(vessel)
    chunk = bytes(CHUNK_BYTES)
    for number in range(1, count + 1):
        digest = hashlib.sha256(number.to_bytes(4)).digest()
        item = OutboxItem("c2", number, key, "", 6, bytes(SIZE), digest)
        for offset in range(0, SIZE - CHUNK_BYTES, CHUNK_BYTES):
            replies = session.get(
                keys.delivery_query(key, "c2"),
                payload=chunk,
                attachment=attachment(b"f" * 16, item, offset),
                timeout=60,
            )
            statuses = {AckReply.unpack(reply.ok.payload.to_bytes(), key).status for reply in replies if reply.ok}
            assert statuses <= {"more", "later"}


def test_incomplete_records_are_deleted_when_the_disk_reserve_is_reached(
    runner, platform, small_disk, tmp_path, texture, client
):
    made = platform("shore-1").model_copy(update={"state_dir": small_disk.folder / "state"})
    service = C2Service(made, C2Config(out_dir=tmp_path / "out"))
    runner.start(service)
    querier = client.declare_querier(keys.delivery_query(keys.shore_inbox("vessel-2"), "c2"))
    eventually(lambda: querier.matching_status.matching)
    begin_records(client, "vessel-2", 5)
    picture = Pixels.from_array(texture(seed=1))
    relay = runner.peer("vessel-1", "relay")
    images = [reconstructed_image(picture, image_id=f"{number:04X}") for number in range(20)]
    relay.send(keys.shore_inbox("vessel-1"), "c2", *map(relayed, images))
    eventually(lambda: service.health().counters.get("images_stored", 0) == 20)
    (stored,) = service.store._query("SELECT COALESCE(SUM(has), 0) FROM partial")[0]
    assert stored <= 2 * SIZE
