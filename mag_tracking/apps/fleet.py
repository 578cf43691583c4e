"""Enrolled vehicles: add the passages of a recording, and recognise them in others."""

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
from mag_tracking.recording.fleet_file import FleetPass


def induction_of(network: SensorNetwork) -> FloatArray:
    """(3,) [A/m] of the earth's field; raises NetworkError where it is not known."""
    if network.earth_field is None or not network.earth_field.any():
        raise NetworkError('the network file has no earth_field, without which hard and soft iron '
                           'cannot be separated')
    return network.earth_field / MU0


def pass_of(recording: str, passages: Sequence[VehiclePassage]) -> FleetPass:
    """The only passage of a recording, to enrol a vehicle.

    Raises
    ------
    LabelsError
        If there is no passage, more than one, or a doubtful one.
    """
    if len(passages) != 1:
        raise LabelsError(f'{recording}: expected one vehicle to enrol, {len(passages)} crossed a '
                          'line')
    (p,) = passages
    if p.ambiguous:
        raise LabelsError(f'{recording}: the passage is doubtful ({", ".join(p.doubts)})')
    return FleetPass(p.moment, p.moment_covariance, _heading(p), f'{recording} {p.number}')


class Fleet:
    """Enrolled vehicles of one site."""

    def __init__(self, passes: dict[str, list[FleetPass]], network: SensorNetwork) -> None:
        """Raises LabelsError for a vehicle that cannot be enrolled, and NetworkError."""
        self._induction = induction_of(network)
        self.vehicles: list[EnrolledVehicle] = []
        for name, mine in passes.items():
            try:
                self.vehicles.append(enrol(
                    name, np.array([p.moment for p in mine]).reshape(-1, 3),
                    np.array([p.covariance for p in mine]).reshape(-1, 3, 3),
                    np.array([p.heading for p in mine]), self._induction))
            except ValueError as error:
                raise LabelsError(str(error)) from error

    def identify(self, passage: VehiclePassage) -> Identification:
        """Which of the vehicles crossed a line."""
        return identify(self.vehicles, passage.moment, passage.moment_covariance,
                        _heading(passage), passage.heading_std, self._induction)


def _heading(passage: VehiclePassage) -> float:
    """[rad] of the velocity."""
    return float(np.arctan2(passage.velocity[1], passage.velocity[0]))
