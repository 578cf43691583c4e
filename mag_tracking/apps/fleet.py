"""Enrolment of vehicles from recorded passages, and their recognition in other recordings."""

from collections.abc import Sequence

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import LabelsError, NetworkError
from mag_tracking.event_records import VehiclePassage
from mag_tracking.inference.identification import (
    EnrolledVehicle,
    Identification,
    enrol,
    identify,
)
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.dipole import MU0
from mag_tracking.results.traffic_tables import FleetPass


def earth_field_strength(network: SensorNetwork) -> FloatArray:
    """Magnetic field strength (3,) of the Earth [A/m], world frame; raises NetworkError if
    unknown."""
    if network.earth_field is None or not network.earth_field.any():
        raise NetworkError('hard and soft iron cannot be separated without the field of the Earth: '
                           'add earth_field to the network file')
    return network.earth_field / MU0


def pass_of(recording: str, passages: Sequence[VehiclePassage]) -> FleetPass:
    """Convert the only passage in a recording to a pass for the enrolment of a vehicle; raises
    LabelsError if there is not exactly one passage, or it is ambiguous."""
    if len(passages) != 1:
        raise LabelsError(f'{recording}: expected exactly one vehicle to enrol, but '
                          f'{len(passages)} crossed a line')
    (p,) = passages
    if p.ambiguous:
        raise LabelsError(f'{recording}: the passage is ambiguous ({", ".join(p.doubts)}); record '
                          'another passage')
    return FleetPass(p.moment, p.moment_covariance, _heading(p), f'{recording} {p.number}')


class Fleet:
    """Enrolled vehicles of one site, from the passes of each; raises LabelsError if a vehicle
    cannot be enrolled, NetworkError if the Earth's field is unknown."""

    def __init__(self, passes: dict[str, list[FleetPass]], network: SensorNetwork) -> None:
        self._field_strength = earth_field_strength(network)
        self.vehicles: list[EnrolledVehicle] = []
        for name, vehicle_passes in passes.items():
            try:
                self.vehicles.append(enrol(
                    name, np.array([p.moment for p in vehicle_passes]).reshape(-1, 3),
                    np.array([p.covariance for p in vehicle_passes]).reshape(-1, 3, 3),
                    np.array([p.heading for p in vehicle_passes]), self._field_strength))
            except ValueError as error:
                raise LabelsError(str(error)) from error

    def identify(self, passage: VehiclePassage) -> Identification:
        """Identify the vehicle of a passage."""
        return identify(self.vehicles, passage.moment, passage.moment_covariance,
                        _heading(passage), passage.heading_std, self._field_strength)


def _heading(passage: VehiclePassage) -> float:
    """Return the heading of a passage, anticlockwise from x [rad]."""
    return float(np.arctan2(passage.velocity[1], passage.velocity[0]))
