"""Command `mag-tracking classes`."""

import argparse
from collections import Counter
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mag_tracking.analysis.signature_classifier import train
from mag_tracking.apps import classes
from mag_tracking.arrays import FloatArray
from mag_tracking.cli.options import Commands, add_command, add_network, check_writable
from mag_tracking.errors import OutputError, SettingsError
from mag_tracking.network.file import read_network
from mag_tracking.quantities import quantity
from mag_tracking.recording.signature_tables import read_model, write_model

_CLASSES_HELP = '''
A single sensor determines neither the moment nor the distance of a target. A classifier that was
trained on labelled passes identifies the class of a target by the shape of its field over a pass.

LABELLED is one of:
  - a CSV table with one row per sample (label, signature, time_s, x_nt, y_nt, z_nt) or one row per
    signature (label, x0, x1, ..., y0, y1, ...). An optional column `pass` identifies the signatures
    of one target at several sensors. signatures.csv of `mag-tracking replay --tables events` is
    such a table without labels.
  - a recording, with --network FILE and --labels FILE, a CSV table of intervals (label, begin_s,
    end_s, optional sensor; seconds since the first reading or since 1970, or begin_ns and end_ns).

train selects the method by cross-validation and writes the model as JSON. evaluate trains and
tests on stratified splits, or tests an existing model. predict prints the probability of each
class. A signature far from all examples is classified as "unknown".

examples:
  mag-tracking classes evaluate passes.csv
  mag-tracking classes train passes.csv --out classes.json
  mag-tracking classes train monday.mcap --network site.yaml --labels monday.csv --out classes.json
  mag-tracking classes predict events/signatures.csv --model classes.json
'''


def add(commands: Commands) -> None:
    """Register the commands."""
    for name, run in (('train', _train), ('evaluate', _evaluate), ('predict', _predict)):
        p = add_command(commands, f'classes {name}', run, _CLASSES_HELP)
        p.add_argument('labelled', type=Path, metavar='LABELLED',
                       help='table of signatures (.csv) or recording')
        p.add_argument('--labels', type=Path, metavar='FILE',
                       help='table of the labelled intervals of a recording (.csv)')
        add_network(p, required=False, text='network file, required for a recording')
        if name == 'train':
            p.add_argument('--out', type=Path, required=True, metavar='FILE',
                           help='model file to write (.json)')
        else:
            p.add_argument('--model', type=Path, required=name == 'predict', metavar='FILE',
                           help='model file written by `classes train`')
        if name == 'evaluate':
            p.add_argument('--splits', type=int, default=20, metavar='N',
                           help='number of 70/30 splits, if --model is not given (default: 20)')


def _examples(args: argparse.Namespace) -> classes.Examples:
    """Read the signatures given by the options; print a warning for each unusable signature."""
    network = None if args.network is None else read_network(args.network)
    examples = classes.examples_of(classes.labelled_signatures(args.labelled, args.labels, network,
                                                               args.action != 'predict'))
    for reason in examples.unusable:
        print(f'  warning: not used: {reason}')
    return examples


def _train(args: argparse.Namespace) -> int:
    check_writable(args.out)
    if any(path is not None and path.resolve() == args.out.resolve()
           for path in (args.labelled, args.labels, args.network)):
        raise OutputError(f'--out: {args.out} is an input of this command; choose another file')
    examples = _examples(args)
    model = train(examples.x, examples.labels, examples.groups, examples.axes, examples.unit)
    write_model(args.out, model)
    print(f'{args.out}: {model.method}; '
          + ', '.join(f'{n} of {name}' for name, n in sorted(model.examples.items())))
    return 0


def _evaluate(args: argparse.Namespace) -> int:
    if args.splits < 1:
        raise SettingsError(f'--splits: expected 1 or more, got {args.splits}')
    examples = _examples(args)
    model = None if args.model is None else read_model(args.model)
    evaluation = classes.evaluate_classes(examples, model, args.splits,
                                          partial(tqdm, desc='splits', disable=None, leave=False))
    test_method = f'{quantity(args.splits, "split")} of 70/30' if model is None else f'{args.model}'
    print(f'{quantity(len(examples.labels), "signature")}, {test_method}; {evaluation.n} tested')
    print(f'  largest class: {evaluation.majority:.1%} (accuracy of a constant prediction)')
    for name, values in (('accuracy', evaluation.accuracy),
                         ('balanced accuracy', evaluation.balanced_accuracy),
                         ('classified as unknown', evaluation.unknown)):
        print(f'  {name}: {_mean_fraction(values)}')
    for k, name in enumerate(evaluation.classes):
        print(f'  recall of {name}: {_mean_fraction(evaluation.recall[:, k])}')
    print('  expected calibration error of the probabilities: '
          f'{evaluation.expected_calibration_error:.3f}')
    return 0


def _mean_fraction(values: FloatArray) -> str:
    """Format the mean of fractions in percent, and their standard deviation; skip NaN values."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 'no examples'
    spread = f' ± {finite.std():.1%}' if len(finite) > 1 else ''
    return f'{finite.mean():.1%}{spread}'


def _predict(args: argparse.Namespace) -> int:
    model, examples = read_model(args.model), _examples(args)
    classes.check_axes(examples, model)
    names, posterior = model.names(examples.x), model.posterior(examples.x)
    for source, name, p in zip(examples.sources, names, posterior, strict=True):
        print(f'{source}: {name} ('
              + ', '.join(f'{c} {v:.1%}' for c, v in zip(model.classes, p, strict=True)) + ')')
    print(', '.join(f'{n} {name}' for name, n in sorted(Counter(names).items())))
    return 0
