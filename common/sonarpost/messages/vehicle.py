"""Records of where a vehicle is and how it does."""

from __future__ import annotations

from typing import Annotated, ClassVar

from pydantic import Field, ValidationInfo, field_validator

from sonarpost.messages.record import Count, Fraction, Latitude, Longitude, Metres, PlatformId, Record, Time


class VehicleStatus(Record):
    """Position and state of a vehicle. A navigation program of the vehicle publishes it, at any interval.

    Attributes:
        vehicle_id: The vehicle.
        time_utc_s: Time of the position and of the values measured with it.
        lat_deg: Position, WGS 84, north positive. None if not known, as in all fields below.
        lon_deg: Position, east positive; a value together with `lat_deg`, or neither.
        heading_deg: Heading, clockwise from true north.
        speed_mps: Speed, forward positive.
        depth_m: Depth below the surface.
        altitude_m: Altitude above the seabed.
        swath_m: Range of the sonar to each side along the seabed, while it records.
        battery: Charge of the battery, 0 to 1.
        images_waiting: Images in the acoustic transmit queue. uuv_modem sets it.
        disk_free_bytes: Free space on the disk of the vehicle. uuv_modem sets it.
    """

    TYPE: ClassVar[str] = "vehicle_status"

    vehicle_id: PlatformId
    time_utc_s: Time
    lat_deg: Latitude | None = None
    lon_deg: Annotated[Longitude | None, Field(validate_default=True)] = None
    heading_deg: Annotated[float, Field(ge=0, lt=360)] | None = None
    speed_mps: Annotated[float, Field(ge=-50, le=50)] | None = None
    depth_m: Annotated[float, Field(ge=-100, le=12000)] | None = None
    altitude_m: Metres | None = None
    swath_m: Metres | None = None
    battery: Fraction | None = None
    images_waiting: Count | None = None
    disk_free_bytes: Count | None = None

    @field_validator("lon_deg")
    @classmethod
    def _check_position(cls, lon_deg: float | None, info: ValidationInfo) -> float | None:
        if "lat_deg" in info.data and (info.data["lat_deg"] is None) != (lon_deg is None):
            raise ValueError("a value together with lat_deg, or neither")
        return lon_deg


class ReceivedStatus(Record):
    """The status of a vehicle as received on the vessel.

    Attributes:
        vessel_id: Vessel that received it.
        vehicle_id: Vehicle that sent it, identified by the address of its modem.
        received_utc_s: When it was received.
        status: The status; its `vehicle_id` is the same. The acoustic link rounds its values.
        authenticated: Whether its acoustic frame was authenticated with a key.
    """

    TYPE: ClassVar[str] = "received_status"

    vessel_id: PlatformId
    vehicle_id: PlatformId
    received_utc_s: Time
    status: VehicleStatus
    authenticated: bool

    @field_validator("status")
    @classmethod
    def _check_vehicle(cls, status: VehicleStatus, info: ValidationInfo) -> VehicleStatus:
        if "vehicle_id" in info.data and status.vehicle_id != info.data["vehicle_id"]:
            raise ValueError("the status of vehicle_id")
        return status


class VehicleRange(Record):
    """The distance between the modems of a vessel and a vehicle, from the travel time of a ping and its answer.

    A ping and its answer are not authenticated.

    Attributes:
        vessel_id: Vessel that measured it.
        vehicle_id: The vehicle.
        measured_utc_s: Arrival of the answer.
        travel_s: One-way travel time.
        sound_speed_mps: Sound speed that the distance is computed with.
        distance_m: Slant distance.
    """

    TYPE: ClassVar[str] = "vehicle_range"

    vessel_id: PlatformId
    vehicle_id: PlatformId
    measured_utc_s: Time
    travel_s: Annotated[float, Field(ge=0, le=100)]
    sound_speed_mps: Annotated[float, Field(ge=1300, le=1700)]
    distance_m: Annotated[float, Field(ge=0, le=170_000)]
