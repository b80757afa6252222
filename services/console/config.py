"""Configuration of the console: the `[console]` table."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sonarpost.config import ServiceConfig
from sonarpost.keys import SHORE
from sonarpost.messages import Latitude, Longitude, PlatformId

ConsumerName = Annotated[str, Field(pattern=r"^[a-z0-9][a-z0-9_-]{0,39}$")]
HostName = Annotated[str, Field(pattern=r"^[A-Za-z0-9.:\[\]_-]{1,253}$")]
LOCAL = ("127.0.0.1", "localhost", "::1")


class ConsoleConfig(ServiceConfig):
    """Where the page is served, to whom what is sent, and when what is shown is old.

    Attributes:
        role: On a vessel operators decide; ashore experts advise.
        site: Ashore: name of the c2's site in keys.
        host: Address that is listened on; other than the host's own only with TLS, or with `insecure`.
        port: TCP port.
        names: Names by which browsers reach it, besides `host` and the host's own.
        tls: Serve by TLS, with the platform's certificate.
        insecure: Serve other hosts without TLS: for a container whose port is published on its own host only.
        behind_proxy: Take the address of a browser from `X-Forwarded-For`.
        decision_consumers: On a vessel: services that are owed decisions.
        command_consumers: On a vessel: services that are owed requests.
        vehicles: Names of the vehicles by the modem addresses they send from, as in `[op_modem]`.
        out_dir: Ashore: c2's folder, for what was accepted while the console was away; none by default.
        downlink_rate: Micro-Modem rate of the vessel, as in `[op_modem]`; for the cost of requests.
        assumed_rate: Rate of vehicles that were not heard yet.
        group_radius_m: How near looks at one object lie where positions are well known.
        session_s: A session ends after so long without use ...
        session_max_s: ... and in any case after so long.
        vehicle_stale_s: A vehicle not heard for so long is shown as stale.
        classes: Classes of mine-like objects that are offered.
        vessel_lat_deg: Where the vessel lies, together with `vessel_lon_deg`, for the map; not known by default.
        vessel_lon_deg: Where the vessel lies.
        ring_m: Radii of the range rings on the map.
        tiles_dir: Folder of map tiles, `{z}/{x}/{y}.png`; none by default.
    """

    role: Literal["vessel", "shore"] = "vessel"
    site: PlatformId = SHORE
    host: HostName = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8470
    names: tuple[HostName, ...] = ()
    tls: bool = False
    insecure: bool = False
    behind_proxy: bool = False
    decision_consumers: tuple[ConsumerName, ...] = ("relay", "op_modem")
    command_consumers: tuple[ConsumerName, ...] = ("op_modem",)
    vehicles: dict[Annotated[str, Field(pattern=r"^[0-9]{1,3}$")], PlatformId] = Field(default_factory=dict)
    out_dir: Path | None = None
    downlink_rate: Annotated[int, Field(ge=0, le=6)] = 0
    assumed_rate: Annotated[int, Field(ge=0, le=6)] | None = None
    group_radius_m: Annotated[float, Field(gt=0, le=1000)] = 8.0
    session_s: Annotated[float, Field(gt=0, le=604800)] = 4 * 3600.0
    session_max_s: Annotated[float, Field(gt=0, le=604800)] = 24 * 3600.0
    vehicle_stale_s: Annotated[float, Field(gt=0, le=86400)] = 120.0
    classes: tuple[Annotated[str, Field(min_length=1, max_length=60)], ...] = ("manta", "rockan", "cylinder", "sphere")
    vessel_lat_deg: Latitude | None = None
    vessel_lon_deg: Longitude | None = None
    ring_m: tuple[Annotated[float, Field(gt=0, le=100000)], ...] = (100.0, 200.0, 500.0)
    tiles_dir: Path | None = None

    @model_validator(mode="after")
    def _is_safe(self) -> ConsoleConfig:
        if self.host not in LOCAL and not (self.tls or self.insecure):
            raise ValueError(f"tls = true for host {self.host}: passwords go over this connection")
        if (self.vessel_lat_deg is None) != (self.vessel_lon_deg is None):
            raise ValueError("vessel_lat_deg and vessel_lon_deg together")
        return self

    def name_of(self, address: int) -> str:
        """Return the name of the vehicle with a modem address."""
        return self.vehicles.get(str(address), f"modem-{address}")
