"""Fixtures of these tests; `builders.services` makes them."""

from builders.services import (
    check_monitoring,
    full_disk,
    modem_pair,
    publish,
    put_file,
    refused,
    runner,
    serial_cable,
    short_retry_delays,
    snippet,
    survey_bytes,
    texture,
    unwritable,
    watch,
)

__all__ = [
    "check_monitoring",
    "full_disk",
    "modem_pair",
    "publish",
    "put_file",
    "refused",
    "runner",
    "serial_cable",
    "short_retry_delays",
    "snippet",
    "survey_bytes",
    "texture",
    "unwritable",
    "watch",
]
