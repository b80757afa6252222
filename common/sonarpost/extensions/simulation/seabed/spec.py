"""Specification of a simulated survey."""

from dataclasses import dataclass

from sonarpost.errors import ConfigError
from sonarpost.extensions.simulation.seabed.objects import ObjectKind
from sonarpost.extensions.simulation.seabed.terrain import SeabedKind


@dataclass(frozen=True, slots=True)
class SurveySpec:
    """Specification of a survey. The same values give the same survey, sample for sample.

    Attributes:
        seed: Seed of every random draw.
        pings: 1 to 10,000.
        samples: Samples per side, 64 to 8192.
        range_m: Slant range per side.
        altitude_m: Mean altitude; at most half the range.
        speed_mps: Speed over ground.
        ping_rate_hz: Pings per second; the echo must return before the next ping.
        heading_deg: Mean course, true.
        start_lat_deg: Latitude of the first ping.
        start_lon_deg: Longitude of the first ping.
        start_time_utc_s: Time of the first ping.
        seabed: Type of seabed.
        targets: Number or kinds of the mine-like objects.
        clutter: Number or kinds of the other objects.
        bits: 8 or 16 bits per sample.
        motion: Scale of the vehicle's yaw, roll and altitude variations: 0 none, 1 typical.
        water_depth_m: Mean depth of the seabed; at least the altitude.
        frequency_hz: Sonar frequency, recorded in the survey.
        burial: Greatest random fraction of an object's height that is below the seabed, 0 to 0.8.
        tilt_deg: Greatest random inclination of an object's long axis, 0 to 30.
        scour: Depth of the pits around objects: 0 none, 1 typical, up to 3.
        ripple_wavelength_m: Distance between ripple crests, 0.2 to 20; None for a random one of 0.55 to 1.1 m.
        ripple_systems: Superposed ripple systems of different wavelength and direction, 1 to 4.
        tvg_error: Error of the exponent of the time-varied gain in amplitude, -2 to 2; gain at half range stays.
        gain_steps: Number of times that the recorder changes its gain, 0 to 100.
        gain_step_db: Greatest change of gain at a step, 0 to 30.
        crosstalk_db: Level of the other side in each side, -80 to 0; None for no crosstalk.
        beam_width_deg: Horizontal beam width between half-power points, 0.1 to 5.
        pulse_sigma_samples: Standard deviation of the pulse, in samples, 0.3 to 20; its length is 2.4 times this.
        surface_return: Echo of the sea surface at the vehicle's depth: 0 none, 1 that of sand at half range; up to 10.

    Raises:
        ConfigError: A value that `sonarpost simulate` sets is outside these limits.
    """

    seed: int = 0
    pings: int = 1000
    samples: int = 1024
    range_m: float = 30.0
    altitude_m: float = 5.0
    speed_mps: float = 1.5
    ping_rate_hz: float = 15.0
    heading_deg: float = 40.0
    start_lat_deg: float = 56.45
    start_lon_deg: float = -5.6
    start_time_utc_s: float = 1_475_568_000.0
    seabed: SeabedKind = SeabedKind.MIXED
    targets: int | tuple[ObjectKind, ...] = 4
    clutter: int | tuple[ObjectKind, ...] = 6
    bits: int = 8
    motion: float = 1.0
    water_depth_m: float = 20.0
    frequency_hz: float = 600_000.0
    burial: float = 0.0
    tilt_deg: float = 0.0
    scour: float = 0.0
    ripple_wavelength_m: float | None = None
    ripple_systems: int = 1
    tvg_error: float = 0.0
    gain_steps: int = 0
    gain_step_db: float = 6.0
    crosstalk_db: float | None = None
    beam_width_deg: float = 0.5
    pulse_sigma_samples: float = 0.7
    surface_return: float = 0.0

    def __post_init__(self) -> None:
        limits = {
            "seed": (self.seed, 0, 2**63),
            "pings": (self.pings, 1, 10_000),
            "samples": (self.samples, 64, 8192),
            "range_m": (self.range_m, 5, 200),
            "altitude_m": (self.altitude_m, 1, self.range_m / 2),
            "ping_rate_hz": (self.ping_rate_hz, 0.5, 750 / self.range_m),
            "water_depth_m": (self.water_depth_m, self.altitude_m, 6000),
            "targets": (_count(self.targets), 0, 1000),
            "clutter": (_count(self.clutter), 0, 1000),
            "burial": (self.burial, 0, 0.8),
            "scour": (self.scour, 0, 3),
        }
        for name, (value, low, high) in limits.items():
            if not low <= value <= high:
                raise ConfigError("survey simulator", name, value, f"{low:g} to {high:g}")

    @property
    def ping_spacing_m(self) -> float:
        """Distance between pings along the track."""
        return self.speed_mps / self.ping_rate_hz

    @property
    def sample_m(self) -> float:
        """Slant range of one sample."""
        return self.range_m / self.samples


def _count(objects: int | tuple[ObjectKind, ...]) -> int:
    return objects if isinstance(objects, int) else len(objects)
