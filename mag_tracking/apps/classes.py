"""Classification of passes by the signature at one sensor: training and evaluation."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from mag_tracking.analysis import signature_classifier as classifier
from mag_tracking.analysis.signature import Signature
from mag_tracking.arrays import FloatArray
from mag_tracking.errors import LabelsError
from mag_tracking.network import SensorNetwork
from mag_tracking.pipeline import Pipeline, RecordReceiver, settings_for
from mag_tracking.recording import signature_tables
from mag_tracking.recording.reader import Recording
from mag_tracking.records import Readings
from mag_tracking.run import RecordingSource, run


@dataclass(frozen=True)
class Examples:
    """Features (n, n_features) of signatures; those of the same target have equal `groups`, and
    `unusable` has a message for each signature without features."""

    x: FloatArray
    labels: tuple[str, ...]
    sources: tuple[str, ...]
    groups: tuple[str, ...]
    axes: tuple[str, ...]
    unit: str
    unusable: tuple[str, ...]


def examples_of(signatures: list[Signature]) -> Examples:
    """Compute features; raises LabelsError if no signature is usable, or axes or units differ."""
    if not signatures:
        raise LabelsError('the input contains no signatures')
    x, rows, reasons = classifier.feature_table(signatures)
    if not len(rows):
        raise LabelsError(f'no signature is usable; reason for the first: {reasons[0]}')
    usable = [signatures[i] for i in rows.tolist()]
    return Examples(x, tuple(s.label for s in usable), tuple(s.source for s in usable),
                    tuple(s.group for s in usable), usable[0].axes, usable[0].unit, tuple(reasons))


def labelled_signatures(path: str | PathLike[str], labels: str | PathLike[str] | None = None,
                        network: SensorNetwork | None = None, is_labelled: bool = True
                        ) -> list[Signature]:
    """Read the signatures in a table, or extract them from the intervals in the table `labels` of a
    recording; raises LabelsError if inputs are missing, contradictory or without readings."""
    if Path(path).suffix.lower() == '.csv' and labels is None:
        return signature_tables.read_signatures(path, is_labelled)
    if labels is None or network is None:
        raise LabelsError(f'{path}: a recording needs a table of labelled intervals and a network')
    return list(_interval_signatures(Path(path), labels, network))


class _CalibratedReadings(RecordReceiver):
    def __init__(self) -> None:
        self.batches: list[Readings] = []
        self.add_calibrated = self.batches.append


def _interval_signatures(path: Path, labels: str | PathLike[str], network: SensorNetwork
                         ) -> Iterator[Signature]:
    """Extract one signature per labelled interval and sensor; raises LabelsError."""
    sink = _CalibratedReadings()
    run(RecordingSource(Recording(path), network),
        Pipeline(network, settings_for('vehicle'), 'calibrate'), [sink])
    readings = Readings.joined(sink.batches)
    if not len(readings):
        raise LabelsError(f'{path}: no sensor has calibrated readings')
    for interval in signature_tables.read_intervals(labels, int(readings.stamp_ns.min())):
        if interval.sensor and interval.sensor not in network.names:
            raise LabelsError(f'{labels}: row {interval.row}: the network has no sensor '
                              f'{interval.sensor!r}; its sensors are {", ".join(network.names)}')
        signatures = list(_signatures(path, readings, interval))
        if not signatures:
            raise LabelsError(f'{labels}: row {interval.row}: the interval contains no readings')
        yield from signatures


def _signatures(path: Path, readings: Readings, interval: signature_tables.LabelledInterval
                ) -> Iterator[Signature]:
    """Extract the signatures of one interval, one per sensor with readings in the interval."""
    is_inside = (interval.begin_ns <= readings.stamp_ns) & (readings.stamp_ns <= interval.end_ns)
    for j, name in enumerate(readings.names):
        selected = is_inside & (readings.sensor == j)
        if interval.sensor not in ('', name) or not selected.any():
            continue
        field = readings.field[selected]
        has_axis = ~np.isnan(field).all(axis=0)
        is_complete = ~np.isnan(field[:, has_axis]).any(axis=1)
        if has_axis.any() and is_complete.any():
            yield Signature((readings.stamp_ns[selected][is_complete] - interval.begin_ns) / 1e9,
                            field[:, has_axis][is_complete], interval.label,
                            f'{path.name}: {name}, row {interval.row}',
                            tuple(np.array(list('xyz'))[has_axis].tolist()), 'T',
                            f'row {interval.row}')


def evaluate_classes(examples: Examples, model: classifier.SignatureModel | None = None,
                     n_splits: int = 20,
                     progress: Callable[[Iterable[int]], Iterable[int]] = iter
                     ) -> classifier.Evaluation:
    """Evaluate a trained model, or models trained on `n_splits` stratified splits; raises
    LabelsError if there are too few examples, or the model has different axes or classes."""
    if model is None:
        return classifier.evaluate_splits(examples.x, examples.labels, examples.groups,
                                          examples.axes, examples.unit, n_splits, progress=progress)
    check_axes(examples, model)
    return classifier.evaluate(model, examples.x, examples.labels)


def check_axes(examples: Examples, model: classifier.SignatureModel) -> None:
    """Raise LabelsError if signatures do not have the axes and the unit of a model."""
    if examples.axes != model.axes:
        raise LabelsError(f'the signatures have the axes {" ".join(examples.axes)}, but the model '
                          f'was trained on {" ".join(model.axes)}')
    if examples.unit != model.unit:
        raise LabelsError(f'the signatures are in {examples.unit or "an unknown unit"}, but the '
                          f'model was trained on {model.unit or "an unknown unit"}; column names '
                          'such as x_nt, x_ut and x_t specify the unit')
