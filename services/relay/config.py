"""Configuration of the relay: the `[relay]` table."""

from __future__ import annotations

from collections import Counter
from typing import Annotated

from pydantic import Field, field_validator, model_validator

from sonarpost.config import ConsumerName, ServiceConfig, with_keys
from sonarpost.keys import SHORE
from sonarpost.messages import PlatformId
from sonarpost.services.relay.bearers import bearers

_ADDED = {name: bearer.KEYS for name, bearer in bearers().working().items()}
_BEARERS = {"radio": {"router", "bandwidth_bytes_per_s", "max_bytes"}}
_BEARERS |= {name: {*keys.model_fields} for name, keys in _ADDED.items()}
"""Bearer -> the keys that only its upstreams have."""


@with_keys(*_ADDED.values())
class UpstreamOptions(ServiceConfig):
    """A way to a shore site. By radio, the site receives all images and decisions.

    A site can have one upstream of each bearer.

    Attributes:
        site: Name of the site, `site` in its c2's table.
        bearer: radio: Zenoh, over any IP network. Others are bearers of extensions.
        router: Zenoh endpoints of the site's own router, tried in turn. By default the site is reached through the
            platform's router and its links.
        bandwidth_bytes_per_s: Bandwidth limit for this site, headers included; no limit by default.
        max_bytes: Maximum size of this site's queue. Above it images of the vehicle with the most bytes are dropped for
            this site: later versions before first ones, oldest first. Decisions are never dropped. No limit by default.
    """

    site: PlatformId = SHORE
    router: tuple[str, ...] = ()
    bandwidth_bytes_per_s: Annotated[float, Field(ge=50, le=1e9)] | None = None
    max_bytes: Annotated[int, Field(ge=0)] | None = None
    bearer: Annotated[str, Field(json_schema_extra={"enum": [*_BEARERS]})] = "radio"

    @field_validator("bearer")
    @classmethod
    def _check_name(cls, bearer: str) -> str:
        if bearer not in _BEARERS:
            raise ValueError(" or ".join(map(repr, _BEARERS)))
        return bearer

    @model_validator(mode="after")
    def _check_keys(self) -> UpstreamOptions:
        others = set().union(*_BEARERS.values()) - _BEARERS[self.bearer]
        if given := sorted(self.model_fields_set & others):
            raise ValueError(f"no {given[0]} with bearer {self.bearer}")
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

    def added(self) -> tuple[UpstreamOptions, ...]:
        """Return the upstreams by other bearers."""
        return tuple(upstream for upstream in self.upstreams if upstream.bearer != "radio")
