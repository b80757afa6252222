"""Configuration of the relay: the `[relay]` table."""

from __future__ import annotations

from collections import Counter
from typing import Annotated

from pydantic import Field, field_validator

from sonarpost.config import ServiceConfig
from sonarpost.keys import SHORE
from sonarpost.messages import PlatformId

ConsumerName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]


class UpstreamOptions(ServiceConfig):
    """One site above the water that is to have everything.

    Attributes:
        site: Name of the site, `site` in its c2's table.
        router: Zenoh endpoints for a session of this upstream's own, tried in turn; by default the site is reached
            through the platform's router and the links that has.
        bandwidth_bytes_per_s: Most that is sent to this site, headers included; no limit by default.
        max_bytes: Most that waits for this site. Beyond it pictures are dropped for this site, later versions before
            first ones and the oldest first; decisions never. No limit by default.
    """

    site: PlatformId = SHORE
    router: tuple[str, ...] = ()
    bandwidth_bytes_per_s: Annotated[float, Field(ge=50, le=1e9)] | None = None
    max_bytes: Annotated[int, Field(ge=0)] | None = None


class RelayConfig(ServiceConfig):
    """Where records go, and what is done while they cannot.

    Attributes:
        upstreams: Sites, each with a queue of its own; none means the one site `shore`.
        supersede: A newer version of a picture takes the place of older ones that no piece of has been sent of.
        disk_reserve_bytes: Free space below which pictures are left with their senders; decisions are still taken.
        advice_consumers: Who takes advice on the vessel; without any, advice is refused and the shore is told.
        command_consumers: Who takes commands on the vessel; without any, commands are refused and the shore is told.
        drop_removed_upstreams: Forget what waits for a site that is not among the upstreams any more.
    """

    upstreams: tuple[UpstreamOptions, ...] = ()
    supersede: bool = True
    disk_reserve_bytes: Annotated[int, Field(ge=0)] = 67_108_864
    advice_consumers: tuple[ConsumerName, ...] = ()
    command_consumers: tuple[ConsumerName, ...] = ()
    drop_removed_upstreams: bool = False

    @field_validator("upstreams")
    @classmethod
    def _each_site_once(cls, upstreams: tuple[UpstreamOptions, ...]) -> tuple[UpstreamOptions, ...]:
        site, times = Counter(upstream.site for upstream in upstreams).most_common(1)[0] if upstreams else ("", 0)
        if times > 1:
            raise ValueError(f"each site once, not {times} times {site}")
        return upstreams

    @field_validator("advice_consumers", "command_consumers")
    @classmethod
    def _not_the_relay(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        if "relay" in names or "c2" in names:
            raise ValueError("names of services on the vessel, not relay or c2")
        return tuple(dict.fromkeys(names))

    def sites(self) -> tuple[UpstreamOptions, ...]:
        """Return the upstreams, the one site `shore` where none is written."""
        return self.upstreams or (UpstreamOptions(),)
