"""Classification of vehicles by moment and length, and by signatures of one sensor.

Random passes of motorcycles, cars and trucks of two simulators are tracked with two sensors. The
figures are the fraction of counted vehicles, the fraction of correct classes, the recall of each
class and the expected calibration error of the class probabilities. In addition, a classifier is
trained and tested on splits of simulated signatures of one sensor. The aims are 95 % correct
classes and an expected calibration error of at most 0.05.
"""

import sys
from functools import partial

import numpy as np
from tqdm import tqdm

from bench.figures import Figures
from mag_tracking.analysis.signature_classifier import expected_calibration_error
from mag_tracking.apps.classes import evaluate_classes, examples_of
from mag_tracking.event_records import VehiclePassage
from mag_tracking.network.file import read_network
from mag_tracking.pipeline import Pipeline, settings_for
from support.box_vehicles import UNCALIBRATED, random_drive
from support.bundled import NETWORK_FILE
from support.labelled_passes import signatures
from support.random_passes import SIMULATORS, random_course
from support.samples import scenario
from support.scenario import SensorErrorModel
from support.situation_worlds import car, small, truck

FRACTIONS = {'motorcycle': 0.05, 'car': 0.8, 'truck': 0.15}
"""Fractions of the classes, as in `traffic.class_shares`."""
N_PASSES = 120
"""Number of passes per simulator."""
EXAMPLE_COUNTS = {'motorcycle': 30, 'car': 160, 'truck': 30}
"""Number of signatures of each class."""
MIN_CORRECT, MAX_CALIBRATION_ERROR = 0.95, 0.05


def body_of(rng, name, simulator):
    """Create a random body of the class `name`; motorcycles are heavy touring motorcycles."""
    if name == 'motorcycle':
        return small(rng, simulator, rng.uniform(1.9, 2.3), rng.uniform(40.0, 120.0))
    return (car if name == 'car' else truck)(rng, simulator)


def classified_pass(simulator, seed):
    """Track one pass, 2.9 to 6.1 m from the sensors; return (class, `VehiclePassage` or None)."""
    rng = np.random.default_rng([seed, SIMULATORS.index(simulator)])
    name = str(rng.choice(list(FRACTIONS), p=list(FRACTIONS.values())))
    path, duration, closest_s = random_course(rng, False)
    course, flaws = (path, SensorErrorModel()) if simulator == 'clouds' else \
        (random_drive(rng, path, closest_s), UNCALIBRATED)
    network = read_network(NETWORK_FILE)
    readings, *_ = scenario.simulate(network, body_of(rng, name, simulator), course, 100.0,
                                     duration + 3.0, rng, flaws)
    pipeline = Pipeline(network, settings_for('vehicle'))
    passages = [r for r in pipeline.feed(readings) + pipeline.flush()
                if isinstance(r, VehiclePassage)]
    return name, passages[0] if passages else None


def main():
    """Print the figures; return 1 if an aim is missed."""
    figures = Figures('classes')
    print('Vehicle classes by moment and length, two sensors')
    classes = settings_for('vehicle').traffic.class_names
    for simulator in SIMULATORS:
        found = [classified_pass(simulator, seed) for seed in tqdm(
            range(N_PASSES), desc=simulator, disable=None, leave=False)]
        counted = [(name, p) for name, p in found if p is not None]
        is_correct = np.array([p.vehicle_class == name for name, p in counted])
        figures.add(f'{simulator}: counted', len(counted) / N_PASSES, '', None, True)
        figures.add(f'{simulator}: correct classes', float(is_correct.mean()), '', MIN_CORRECT,
                    True)
        for kind in classes:
            of_kind = np.array([name == kind for name, _ in counted])
            figures.add(f'{simulator}: recall of {kind}', float(is_correct[of_kind].mean()), '',
                        None, True, f' (of {of_kind.sum()})')
        probability = np.array([p.class_probabilities.max() for _, p in counted])
        is_best = np.array([classes[int(np.argmax(p.class_probabilities))] == name
                            for name, p in counted])
        figures.add(f'{simulator}: expected calibration error',
                    expected_calibration_error(probability, is_best), '', MAX_CALIBRATION_ERROR)
    for simulator in SIMULATORS:
        examples = examples_of(signatures(EXAMPLE_COUNTS, simulator))
        found = evaluate_classes(examples, progress=partial(
            tqdm, desc='splits', disable=None, leave=False))
        figures.add(f'{simulator}, one sensor: accuracy', float(found.accuracy.mean()), '', None,
                    True, f' (fraction of the largest class {found.majority:.3f})')
        figures.add(f'{simulator}, one sensor: balanced accuracy',
                    float(found.balanced_accuracy.mean()), '', None, True)
        figures.add(f'{simulator}, one sensor: expected calibration error',
                    found.expected_calibration_error, '', MAX_CALIBRATION_ERROR)
    return figures.save()


if __name__ == '__main__':
    sys.exit(main())
