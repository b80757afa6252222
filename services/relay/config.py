"""Configuration of the relay: the `[relay]` table."""

from __future__ import annotations

from collections import Counter
from typing import Annotated

from pydantic import Field, field_validator

from sonarpost.config import ConsumerName, ServiceConfig
from sonarpost.keys import SHORE
from sonarpost.messages import PlatformId


class UpstreamOptions(ServiceConfig):
    """A shore site that receives all images and decisions.

    Attributes:
        site: Name of the site, `site` in its c2's table.
        router: Zenoh endpoints of the site's own router, tried in turn. By default the site is reached through the
            platform's router and its links.
        bandwidth_bytes_per_s: Bandwidth limit for this site, headers included; no limit by default.
        max_bytes: Maximum size of this site's queue. Above it images are dropped for this site: later versions before
            first ones, oldest first. Decisions are never dropped. No limit by default.
    """

    site: PlatformId = SHORE
    router: tuple[str, ...] = ()
    bandwidth_bytes_per_s: Annotated[float, Field(ge=50, le=1e9)] | None = None
    max_bytes: Annotated[int, Field(ge=0)] | None = None


class RelayConfig(ServiceConfig):
    """The `[relay]` table.

    Attributes:
        upstreams: Sites, each with its own queue; empty means the single site `shore`.
        supersede: A newer version of an image replaces queued older ones whose transfer has not started.
        disk_reserve_bytes: Free space below which images are not accepted; decisions still are.
        advice_consumers: Services on the vessel that receive advice; without any, advice is refused.
        command_consumers: Services on the vessel that receive commands; without any, commands are refused.
        drop_removed_upstreams: Drop the records queued for sites that are no longer configured.
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
        """Return the upstreams; the single site `shore` if none is configured."""
        return self.upstreams or (UpstreamOptions(),)
