"""Configuration of the relay: the `[relay]` table."""

from __future__ import annotations

from collections import Counter
from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from sonarpost.bearers.policy import Window
from sonarpost.config import ConsumerName, ServiceConfig
from sonarpost.keys import SHORE
from sonarpost.messages import PlatformId

_RADIO_KEYS = frozenset({"router", "bandwidth_bytes_per_s", "max_bytes"})
_SATELLITE_KEYS = frozenset(
    {"terminal", "baud", "after_s", "preview_bytes", "bytes_per_day", "windows", "check_interval_s", "cost_per_kb"}
)


class UpstreamOptions(ServiceConfig):
    """A way to a shore site. By radio, the site receives all images and decisions.

    By satellite it receives short messages with contact records, previews and decisions that no radio upstream of the
    site has delivered within `after_s`. A site can have one upstream of each kind.

    Attributes:
        site: Name of the site, `site` in its c2's table.
        bearer: radio: Zenoh, over any IP network. satellite: a terminal for messages of 340 bytes, on `terminal`.
        router: Zenoh endpoints of the site's own router, tried in turn. By default the site is reached through the
            platform's router and its links.
        bandwidth_bytes_per_s: Bandwidth limit for this site, headers included; no limit by default.
        max_bytes: Maximum size of this site's queue. Above it images of the vehicle with the most bytes are dropped for
            this site: later versions before first ones, oldest first. Decisions are never dropped. No limit by default.
        terminal: Satellite only: serial port of an Iridium 9602 or 9603, or another URL of pyserial.
        baud: Satellite only: bits a second.
        after_s: Satellite only: time that a record waits for the radio first; not used for a site without radio.
        preview_bytes: Satellite only: longest preview of an image. Up to 260 fit a message of one contact; with 75,
            two contacts share a message. 0 sends contact records only.
        bytes_per_day: Satellite only: limit for sent bytes a day in UTC; no limit by default.
        windows: Satellite only: times of the day in UTC when it is used, `HH:MM-HH:MM`; empty for always.
        check_interval_s: Satellite only: interval of the checks for acknowledgements.
        cost_per_kb: Satellite only: price of 1000 bytes, for the gauge of the cost.
    """

    site: PlatformId = SHORE
    router: tuple[str, ...] = ()
    bandwidth_bytes_per_s: Annotated[float, Field(ge=50, le=1e9)] | None = None
    max_bytes: Annotated[int, Field(ge=0)] | None = None
    bearer: Literal["radio", "satellite"] = "radio"
    terminal: str = ""
    baud: Annotated[int, Field(ge=300, le=1_000_000)] = 19200
    after_s: Annotated[float, Field(ge=0, le=604800)] = 120.0
    preview_bytes: Annotated[int, Field(ge=0, le=260)] = 260
    bytes_per_day: Annotated[int, Field(ge=340)] | None = None
    windows: tuple[str, ...] = ()
    check_interval_s: Annotated[float, Field(ge=1, le=86400)] = 120.0
    cost_per_kb: Annotated[float, Field(ge=0, le=1e6)] | None = None

    @field_validator("windows")
    @classmethod
    def _check_windows(cls, windows: tuple[str, ...]) -> tuple[str, ...]:
        for text in windows:
            Window.parse(text)
        return windows

    @model_validator(mode="after")
    def _check_bearer(self) -> UpstreamOptions:
        wrong = _RADIO_KEYS if self.bearer == "satellite" else _SATELLITE_KEYS
        if given := sorted(self.model_fields_set & wrong):
            raise ValueError(f"no {given[0]} with bearer {self.bearer}")
        if self.bearer == "satellite" and not self.terminal:
            raise ValueError("a terminal with bearer satellite")
        return self


class RelayConfig(ServiceConfig):
    """The `[relay]` table.

    Attributes:
        upstreams: Ways to sites, each with its own queue; empty means the single site `shore`.
        supersede: A newer version of an image replaces queued older ones whose transfer has not started.
        forward_status: Send the latest status of each vehicle to every site by radio.
        disk_reserve_bytes: Free space below which images are not accepted; decisions still are.
        comment_consumers: Services on the vessel that receive comments; without any, comments are refused.
        command_consumers: Services on the vessel that receive commands; without any, commands are refused.
        drop_removed_upstreams: Drop the records queued for sites that are no longer configured.
    """

    upstreams: tuple[UpstreamOptions, ...] = ()
    supersede: bool = True
    forward_status: bool = True
    disk_reserve_bytes: Annotated[int, Field(ge=0)] = 67_108_864
    comment_consumers: tuple[ConsumerName, ...] = ()
    command_consumers: tuple[ConsumerName, ...] = ()
    drop_removed_upstreams: bool = False

    @field_validator("upstreams")
    @classmethod
    def _each_site_once(cls, upstreams: tuple[UpstreamOptions, ...]) -> tuple[UpstreamOptions, ...]:
        for (site, bearer), times in Counter((upstream.site, upstream.bearer) for upstream in upstreams).items():
            if times > 1:
                raise ValueError(f"each site once by {bearer}, not {times} times {site}")
        return upstreams

    @field_validator("comment_consumers", "command_consumers")
    @classmethod
    def _not_the_relay(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if "relay" in names or "c2" in names:
            raise ValueError("names of services on the vessel, not relay or c2")
        return tuple(dict.fromkeys(names))

    def sites(self) -> tuple[UpstreamOptions, ...]:
        """Return the radio upstreams; the single site `shore` if no upstream is configured."""
        radio = tuple(upstream for upstream in self.upstreams if upstream.bearer == "radio")
        return radio if self.upstreams else (UpstreamOptions(),)

    def satellites(self) -> tuple[UpstreamOptions, ...]:
        """Return the satellite upstreams."""
        return tuple(upstream for upstream in self.upstreams if upstream.bearer == "satellite")
