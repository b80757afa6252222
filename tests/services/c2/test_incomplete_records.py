"""Records that a vessel begins and never completes do not prevent others from delivering theirs."""

from collections import namedtuple

from builders.common import eventually
from builders.records import decision_record
from builders.shore import relayed

from sonarpost import keys
from sonarpost.delivery.disk_reserve import HANDLING_RESERVE_BYTES
from sonarpost.delivery.protocol import CHUNK_BYTES, AckReply, attachment
from sonarpost.delivery.records import OutboxItem

DiskUsage = namedtuple("DiskUsage", "total used free")


def test_incomplete_records_are_deleted_when_the_disk_reserve_is_reached(begin, relay, client, monkeypatch):
    free = [10**12]
    monkeypatch.setattr("sonarpost.delivery.disk_reserve.shutil.disk_usage", lambda _: DiskUsage(10**12, 0, free[0]))
    service, key = begin(), keys.shore_inbox("vessel-2")

    def chunks_bytes():
        return service.store._query("SELECT COALESCE(SUM(has), 0) FROM partial")[0][0]

    # All chunks but the last of two records, which are larger together than the reserve.
    size = HANDLING_RESERVE_BYTES // CHUNK_BYTES * CHUNK_BYTES
    querier = client.declare_querier(keys.delivery_query(key, "c2"))
    eventually(lambda: querier.matching_status.matching)
    for number in (1, 2):
        item = OutboxItem("c2", number, key, "", 6, bytes(size), bytes([number]) * 32)
        for offset in range(0, size - CHUNK_BYTES, CHUNK_BYTES):
            sent = querier.get(payload=bytes(CHUNK_BYTES), attachment=attachment(b"f" * 16, item, offset))
            assert AckReply.unpack(next(iter(sent)).ok.payload.to_bytes(), key).status == "more"
    assert chunks_bytes() == 2 * (size - CHUNK_BYTES)
    free[0] = 0
    # The disk stays full: the space of the deleted chunks is used again.
    relay.send(keys.shore_inbox("vessel-1"), "c2", relayed(decision_record()))
    eventually(lambda: service.health().counters.get("decisions_stored") == 1)
    assert chunks_bytes() == 0
