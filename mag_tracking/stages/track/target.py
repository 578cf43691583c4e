"""Kinds of target: source model, published orientation, and start of a track."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mag_tracking.arrays import FloatArray
from mag_tracking.errors import SettingsError
from mag_tracking.inference.filter_bank import FilterBank
from mag_tracking.network import SensorNetwork
from mag_tracking.physics.sources import SourceModel
from mag_tracking.records import FieldFrame
from mag_tracking.stages.track.bank_size import check_magnet_bank, check_vehicle_bank
from mag_tracking.stages.track.initiation_magnet import is_lost_after, magnet_model, start_magnet
from mag_tracking.stages.track.initiation_vehicle import start_vehicle, vehicle_model
from mag_tracking.stages.track.published_pose import (
    MagnetOrientation,
    Orientation,
    VehicleOrientation,
)
from mag_tracking.stages.track.settings import TrackSettings
from mag_tracking.stages.track.unobserved_length import UnobservedLength


@dataclass(frozen=True)
class Target:
    """Target that the tracker can follow: a vehicle or a magnet."""

    model: SourceModel
    orientation: Orientation
    arrivals: Sequence[str]
    """Name of each arrival direction."""
    kinds: Sequence[str]
    """Name of each kind of target."""
    unobserved_length: Callable[[], UnobservedLength | None]
    """Factory that is called for each track. It returns the uncertainty of the middle of a vehicle
    due to its unobserved length; None for a magnet."""
    starts_anywhere: bool
    """Whether a track may start anywhere. A lost magnet may be found at any position, but a vehicle
    starts on an arrival line."""
    start: Callable[[TrackSettings, SensorNetwork, FieldFrame, FloatArray], FilterBank | None]
    """Function that returns the first hypotheses from the settings, a network, a frame and the
    covariances (n_sensors, n_own, n_own) of mounting angles and model errors; None if the frame
    does not allow a start."""
    is_lost_after: Callable[[TrackSettings, SensorNetwork, float], bool] = lambda *_: False
    """Function that returns whether the target may be anywhere after a gap [s], so that its
    hypotheses are started again."""


def target_of(settings: TrackSettings, network: SensorNetwork) -> Target:
    """Target that the settings select.

    Raises SettingsError if the target is unknown, if its settings contradict each other, or if the
    start of a track would need too much memory.
    """
    if settings.target == 'vehicle':
        vehicle = settings.vehicle
        row = vehicle_model(vehicle, network)
        check_vehicle_bank(settings, network, row)
        return Target(row, VehicleOrientation(), vehicle.arrival_names,
                      [kind.name for kind in vehicle.kinds],
                      partial(UnobservedLength, [kind.length for kind in vehicle.kinds],
                              [kind.length_std for kind in vehicle.kinds]),
                      False, _start_vehicle)
    if settings.target == 'magnet':
        magnet = settings.magnet
        if not any(magnet.axis):
            raise SettingsError('track.magnet.axis: the zero vector has no direction')
        model = magnet_model(magnet)
        check_magnet_bank(settings, network, model)
        return Target(model,
                      MagnetOrientation(np.array(magnet.axis)),
                      ('',), ('',), lambda: None, True, _start_magnet,
                      lambda s, network, dt: is_lost_after(s.magnet, network, dt))
    raise SettingsError(f'track.target: expected vehicle or magnet, got {settings.target!r}')


def _start_vehicle(settings: TrackSettings, network: SensorNetwork, frame: FieldFrame,
                   own_covariance: FloatArray) -> FilterBank | None:
    """First hypotheses of a vehicle; None if the frame does not allow a start."""
    return start_vehicle(settings.vehicle, network, frame, settings.background_std,
                         own_covariance)


def _start_magnet(settings: TrackSettings, network: SensorNetwork, frame: FieldFrame,
                  own_covariance: FloatArray) -> FilterBank | None:
    """First hypotheses of a magnet; None if the frame does not allow a start."""
    return start_magnet(settings.magnet, network, frame, settings.background_std, own_covariance,
                        settings.field_error)
