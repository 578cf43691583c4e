"""Box vehicle simulator: fields of box vehicles, and speed and heading of a drive."""

import numpy as np
import pytest

from mag_tracking.physics.dipole import dipole_field
from mag_tracking.simulation.scenario import Path, body_poses
from support.box_vehicles import Drive, box_car, box_truck
from support.passes import EARTH


@pytest.mark.parametrize('make_vehicle', [box_car, box_truck])
@pytest.mark.parametrize('heading', [0.0, 2.1])
def test_a_box_vehicle_far_away_has_the_field_of_its_moment(make_vehicle, heading):
    body = make_vehicle(np.random.default_rng(4), moment=500.0)
    R, _ = body_poses(np.zeros((1, 2)), np.array([heading]))
    parts = body.moments((EARTH @ R[0])[None])[0]
    m = R[0] @ parts.sum(axis=0)
    if not heading:
        assert np.linalg.norm(m) == pytest.approx(500.0)
    far = 3000.0 * np.array([[0.6, 0.64, 0.48]])
    B = body.field(EARTH, np.zeros((1, 2)), np.array([heading]), far)[0, 0]
    np.testing.assert_allclose(B, dipole_field(far[0], m), rtol=0.02, atol=0.02 * np.abs(B).max())
    assert make_vehicle(np.random.default_rng(4)).length == body.length


def test_a_sheet_is_magnetised_in_its_plane():
    body = box_car(np.random.default_rng(1))
    floor, side = body.induced[0], body.induced[4]
    assert floor[:2].min() > 5.0 * floor[2] and side[[0, 2]].min() > 5.0 * side[1]


def test_a_drive_follows_its_speed_and_heading():
    drive = Drive(Path(np.array([-50.0, 0.0]), 0.3, 10.0), -0.2, 4.0, 2.0, 0.3, 5.0, 2.0)
    t = np.linspace(0.0, 10.0, 4001)
    position, heading = drive.at(t)
    velocity = np.gradient(position, t, axis=0)[5:-5]
    along = velocity @ [np.cos(0.3), np.sin(0.3)]
    np.testing.assert_allclose(along, drive.speed(t)[5:-5], rtol=2e-3)
    np.testing.assert_allclose(np.arctan2(velocity[:, 1], velocity[:, 0]), heading[5:-5],
                               atol=2e-3)
    assert drive.speed(0.0) == pytest.approx(10.0, rel=1e-3)
    assert drive.speed(9.0) == pytest.approx(8.0, rel=1e-3)
