"""TSP14 Figure 7 with simulated passes: normalised cost against the number of dipoles.

The bundled recordings of single vehicles on a straight road are simulated (sixty magnetised
parts, see test/data/README.md). They are fitted at their original rate of 100 Hz and at 12.5 Hz,
to which T10 section 6.3 decimates before its fits. The published costs refer to 12.5 Hz.

    python examples/tsp14_model_order.py --out out/tsp14
"""

import argparse
from pathlib import Path

from mag_tracking.apps.fit import fit
from mag_tracking.apps.fit_report import order_figure
from mag_tracking.network.file import read_network

ROOT = Path(__file__).resolve().parents[1]
VEHICLES = ('straight_small_left', 'straight_car_right', 'straight_car_fast_left',
            'straight_truck_right')
RATES = {'12.5 Hz': 12.5, '100 Hz': 0.0}
"""`calibrate.decimate_to_hz` for each rate; 0 keeps the recorded rate."""
PUBLISHED = {'cars': ((10.0, 51.0), (1.3, 1.6)), 'large': ((142.0, 360.0), (76.7, 302.6))}
"""TSP14 Tables I and II: (lowest, highest) normalised cost for one and for three dipoles."""


def fit_passes(rate, orders=(1, 2, 3, 4, 5)):
    """Fit the pass in each recording, at a rate of `RATES`; return one `FittedPass` per pass."""
    network = read_network(ROOT / 'config/network.yaml')
    found = []
    for name in VEHICLES:
        recording = ROOT / 'test/data/vehicles' / f'{name}.mcap'
        found += fit(recording, network, {'calibrate.decimate_to_hz': RATES[rate]}, orders).passes
        costs = ', '.join(f'{f.normalised_cost:.2f}' for f in found[-1].fits)
        print(f'{rate}, {name}: {costs}')
    return found


def costs_of(found, n_dipoles):
    """Normalised costs of fits with `n_dipoles` dipoles: (costs of the cars, cost of the truck)."""
    costs = [f.normalised_cost for one in found for f in one.fits if f.n_dipoles == n_dipoles]
    return costs[:-1], costs[-1]


def report(found):
    """Report that compares the costs with the published costs; `found` is {rate: passes}."""
    lines = []
    for n_dipoles, (cars, large) in zip((1, 3), zip(*PUBLISHED.values(), strict=True),
                                        strict=True):
        lines.append(f'{n_dipoles} dipole{"s" if n_dipoles > 1 else ""}; TSP14: cars {cars[0]:g} '
                     f'to {cars[1]:g}, large vehicles {large[0]:g} to {large[1]:g}')
        for rate, fitted in found.items():
            car_costs, truck = costs_of(fitted, n_dipoles)
            lines.append(f'  {rate:8} cars {min(car_costs):.2f} to {max(car_costs):.2f}, '
                         f'truck {truck:.1f}')
    return '\n'.join([*lines, """\
agrees   Every dipole lowers the cost. With three dipoles, the cars come close to one; the truck
         does not.
differs  With one dipole at 12.5 Hz, the cars are below the published range and the truck is above
         it: these are other vehicles, simulated, with other noise. The published fits use data at
         12.5 Hz (T10 section 6.3). At 100 Hz each sample has more noise relative to the model
         error, so the costs are lower."""])


def main(argv=None):
    """Draw the figure for both rates and print the comparison."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--out', type=Path, default=Path('out/tsp14'))
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    found = {rate: fit_passes(rate) for rate in RATES}
    for rate, fitted in found.items():
        figure, path = order_figure(fitted), args.out / f'figure_7_{rate.replace(" ", "_")}.png'
        figure.suptitle(f'TSP14 Figure 7 with simulated passes at {rate} '
                        '(filled: selected order)')
        figure.savefig(path, dpi=110)
        print(path)
    print(report(found))
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
