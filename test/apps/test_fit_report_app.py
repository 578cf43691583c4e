"""Notes in the report of fitted passes."""

import mag_tracking as mt
from mag_tracking.analysis.pass_result import MAX_NORMALISED_COST
from mag_tracking.apps.fit_report import fit_page
from mag_tracking.report.page import WARNING
from support.bundled import NETWORK_FILE, vehicle_path


def test_a_poor_fit_is_reported():
    """Three dipoles describe the car, but not the truck."""
    network = mt.read_network(NETWORK_FILE)
    car, truck = (mt.fit(vehicle_path(name), network, orders=(3,)).passes
                  for name in ('straight_car_right', 'straight_truck_right'))
    costs = [fitted.chosen.normalised_cost for fitted in (*car, *truck)]
    assert costs[0] < MAX_NORMALISED_COST < costs[1]
    assert [note for note in fit_page(car, network, []).notes if note.level == WARNING] == []
    (warning,) = [note for note in fit_page([*car, *truck], network, []).notes
                  if note.level == WARNING]
    assert ': 1 of 2;' in warning.text
