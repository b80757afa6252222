"""Rules of the hand-over that can be switched one by one."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Rules:
    """Rules of producer and consumer.

    Attributes:
        window_of_key: A duplicate window belongs to a key and an origin; otherwise to an origin.
        compare_digest: The identity of a record includes its digest.
        done_up_to_prunes: `done_up_to` only permits to delete digests; else all numbers up to it count as received.
        done_up_to_after_acceptance: `done_up_to` is used only if the record of the query was accepted.
        keep: Number of the newest digests of a window that `done_up_to` never deletes.
        forget_refused: A refused record is validated again; otherwise its number stays refused.
        secret_origin: Watchers do not receive the origin.
        detect_restore: A reply states the highest number; a producer that finds itself older uses a new origin.
        state_reused: A reply to a record whose number was used before states this number and the other digest in place
            of the highest number.
        current_origin_only: The producer compares the highest number only in replies for its current origin.
        origin_of_row: A queued record keeps the origin under which it was queued.
        chunks_of_digest: Chunks belong to a key, an origin, a number and a digest; otherwise another digest replaces
            them.
        fair_chunks: Chunks of the writer with the most incomplete records are deleted first; otherwise those that were
            received first.
        writer_of_prefix: All keys of one prefix count as one writer; otherwise each key is one.
        check_assembled: The digest of an assembled record is checked.
        commit_first: The consumer replies after the commit.
        bind_replies: The producer uses a reply only for the query of this run that caused it.
        validate_key: A record is valid only on its own key.
    """

    window_of_key: bool = True
    compare_digest: bool = True
    done_up_to_prunes: bool = True
    done_up_to_after_acceptance: bool = True
    keep: int = 9
    forget_refused: bool = True
    secret_origin: bool = True
    detect_restore: bool = True
    state_reused: bool = True
    current_origin_only: bool = True
    origin_of_row: bool = True
    chunks_of_digest: bool = True
    fair_chunks: bool = True
    writer_of_prefix: bool = True
    check_assembled: bool = True
    commit_first: bool = True
    bind_replies: bool = True
    validate_key: bool = True


NEW = Rules()
OLD = Rules(
    window_of_key=False,
    compare_digest=False,
    done_up_to_prunes=False,
    done_up_to_after_acceptance=False,
    forget_refused=False,
    secret_origin=False,
    detect_restore=False,
    origin_of_row=False,
    chunks_of_digest=False,
    fair_chunks=False,
)
"""Rules of a consumer that identifies a record by origin and number over all keys."""
