"""Configuration of the console: the `[console]` table."""

from __future__ import annotations

import importlib.util
from ipaddress import IPv4Network, IPv6Network
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator
from typing_extensions import override

from sonarpost.config import ConsumerName, PlatformConfig
from sonarpost.errors import ConfigError
from sonarpost.keys import SHORE
from sonarpost.messages import Latitude, Longitude, PlatformId
from sonarpost.modem.interface import MAX_RATE, ModemCapabilities, RateInfo
from sonarpost.runtime.retention import MaxBytes, RetentionConfig

HostName = Annotated[str, Field(pattern=r"^[A-Za-z0-9.:\[\]_-]{1,253}$")]
ClassNames = Annotated[tuple[Annotated[str, Field(min_length=1, max_length=60)], ...], Field(max_length=200)]
ClassGroups = Annotated[
    dict[
        Annotated[str, Field(min_length=1, max_length=20)],
        Annotated[tuple[Annotated[str, Field(min_length=1, max_length=36)], ...], Field(max_length=100)],
    ],
    Field(max_length=20),
]
LOCAL_HOSTS = ("127.0.0.1", "localhost", "::1")


class ConsoleConfig(RetentionConfig):
    """The `[console]` table.

    Attributes:
        role: `vessel`: operators decide. `shore`: experts comment.
        site: At a shore site: name of the site in key expressions.
        host: Address to listen on. Addresses other than the local host need `tls` or `insecure`.
        port: TCP port; 0 for any free port.
        names: Host names of the console in addition to `host` and the local host.
        tls: Serve HTTPS with the certificate of the platform.
        insecure: Permit other hosts without TLS, for a container whose port is published on the local host only.
        trusted_proxies: Addresses and networks of reverse proxies, whose `X-Forwarded-For` has the browser's address.
        decision_consumers: On a vessel: services to which decisions are sent.
        command_consumers: On a vessel: services to which requests are sent.
        vehicles: Vehicle name for each modem address, as in `[op_modem]`.
        downlink_rate: Rate of the vessel, as in `[op_modem]`, for cost estimates; by default the downlink rate of the
            driver in `[modem]`.
        assumed_rate: Rate of vehicles before their first frame; for cost estimates.
        group_radius_m: Distance limit of looks at one object, for accurate positions.
        mission_gap_s: Contacts at one place whose detection times differ by more are of different missions: not looks
            at one object, but earlier contacts at this place.
        beam_width_deg: Horizontal beam width of the vehicles' sonars between half-power points, which blurs measured
            lengths along the track; 0 for no correction.
        session_s: A session ends after this time without use.
        session_max_s: Maximum duration of a session.
        vehicle_stale_s: A vehicle is stale after this time without a frame.
        take_back_s: A decision is sent after this time, so that the operator can take it back without air time.
        classes: Proposed classes of objects: a list, or a table of groups, for example
            `{ MILCO = ["manta", "rockan"], NOMBO = ["rock"] }`.
        calibration_share: On a vessel: sealed contacts with known objects for each contact of a vehicle, to measure the
            operators' Pd and false alarms; 0 for none. Decisions and requests about them are never sent.
        vessel_lat_deg: Latitude of the vessel for the map, together with `vessel_lon_deg`.
        vessel_lon_deg: Longitude of the vessel.
        ring_m: Radii of the range rings on the map.
        tiles_dir: Folder of map tiles, `{z}/{x}/{y}.png`.
        max_bytes: Maximum size of the images in the console's database; above it the vehicle with the most bytes, with
            several vessels the vessel, loses images: superseded versions before the newest, both those of contacts
            without a decision first, each the oldest first. Contacts, decisions and the audit are never removed.
    """

    role: Literal["vessel", "shore"] = "vessel"
    site: PlatformId = SHORE
    host: HostName = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8470
    names: tuple[HostName, ...] = ()
    tls: bool = False
    insecure: bool = False
    trusted_proxies: tuple[IPv4Network | IPv6Network, ...] = ()
    decision_consumers: tuple[ConsumerName, ...] = ("relay", "op_modem")
    command_consumers: tuple[ConsumerName, ...] = ("op_modem",)
    vehicles: dict[Annotated[str, Field(pattern=r"^[0-9]{1,3}$")], PlatformId] = Field(default_factory=dict)
    downlink_rate: Annotated[int, Field(ge=0, le=MAX_RATE)] | None = None
    assumed_rate: Annotated[int, Field(ge=0, le=MAX_RATE)] | None = None
    group_radius_m: Annotated[float, Field(gt=0, le=1000)] = 8.0
    mission_gap_s: Annotated[float, Field(gt=60, le=1e8)] = 6 * 3600.0
    beam_width_deg: Annotated[float, Field(ge=0, le=5)] = 0.5
    session_s: Annotated[float, Field(gt=0, le=604800)] = 4 * 3600.0
    session_max_s: Annotated[float, Field(gt=0, le=604800)] = 24 * 3600.0
    vehicle_stale_s: Annotated[float, Field(gt=0, le=86400)] = 120.0
    take_back_s: Annotated[float, Field(ge=0, le=60)] = 8.0
    classes: ClassNames | ClassGroups = ("manta", "rockan", "cylinder", "sphere")
    calibration_share: Annotated[float, Field(ge=0, le=0.5)] = 0.0
    vessel_lat_deg: Latitude | None = None
    vessel_lon_deg: Longitude | None = None
    ring_m: tuple[Annotated[float, Field(gt=0, le=100000)], ...] = (100.0, 200.0, 500.0)
    tiles_dir: Path | None = None
    max_bytes: MaxBytes = 20_000_000_000

    def rate_of(self, modem: ModemCapabilities) -> RateInfo:
        """Return the rate of the vessel.

        Raises:
            ConfigError: The modem does not have it.
        """
        number = modem.downlink_rate if self.downlink_rate is None else self.downlink_rate
        if number not in modem.rates:
            raise ConfigError("[console]", "downlink_rate", number, f"one of {sorted(modem.rates)}")
        return modem.rates[number]

    @model_validator(mode="after")
    def _is_consistent(self) -> ConsoleConfig:
        if self.host not in LOCAL_HOSTS and not (self.tls or self.insecure):
            raise ValueError(f"tls = true for host {self.host}: passwords are sent over this connection")
        if self.calibration_share > 0 and self.role != "vessel":
            raise ValueError("calibration_share on a vessel only: no decision is made at a shore site")
        if (self.vessel_lat_deg is None) != (self.vessel_lon_deg is None):
            raise ValueError("vessel_lat_deg and vessel_lon_deg together")
        return self

    @override
    def check_with(self, platform: PlatformConfig) -> None:
        """Check that the web server is installed, and that there is a certificate for `tls`.

        Raises:
            ConfigError: The extra `console` is not installed, or `tls` is set and the platform has no certificate.
        """
        if importlib.util.find_spec("uvicorn") is None:
            expected = "the extra console: pip install 'sonarpost[console]'; or a file without this table"
            raise ConfigError("[console]", "", "no web server installed", expected)
        if self.tls and platform.tls is None:
            raise ConfigError("[console]", "tls", "true", "a certificate in [platform] tls")

    def class_groups(self) -> dict[str, list[str]]:
        """Return the proposed classes by group, as decisions state them: `MILCO > manta`. A list has the group ""."""
        if not isinstance(self.classes, dict):
            return {"": list(self.classes)}
        return {group: [group, *(f"{group} > {kind}" for kind in kinds)] for group, kinds in self.classes.items()}

    def vehicle_name(self, address: int) -> str:
        """Return the name of the vehicle with a modem address."""
        return self.vehicles.get(str(address), f"modem-{address}")
