"""Names chosen by the user are drawn literally in figures, never as mathematics."""

import io
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure

from mag_tracking.analysis.track_log import TrackLog
from mag_tracking.apps.calibrate_report import calibration_figure, geometry_figure, tumble_figure
from mag_tracking.apps.fit_report import order_figure, pass_figure
from mag_tracking.apps.plan_report import lane_figure
from mag_tracking.network import SensorNetwork
from mag_tracking.report.figures import field_figure, map_figure, weights_figure
from mag_tracking.report.style import literal

NAMES = ('$\\foo$', '_hidden $^{$', '\\$5$')


def texts_of(figure):
    """Draw a figure and return its strings; drawing fails for a name parsed as mathematics."""
    figure.savefig(io.BytesIO(), dpi=40)
    return {t.get_text().replace('\\$', '$').replace('\u200b', '') for t in figure.findobj(
        lambda artist: hasattr(artist, 'get_text'))}


@pytest.mark.parametrize('text', [*NAMES, '$', '$a\n$', '__', 'left', ''])
def test_a_string_is_drawn_literally(text):
    figure = Figure()
    axes = figure.add_subplot()
    axes.plot([0, 1], label=literal(text) or 'none')
    axes.legend()
    assert (text or 'none') in texts_of(figure)


NETWORK = SensorNetwork(NAMES, np.eye(3), np.repeat(np.eye(3)[None], 3, axis=0),
                        ('/a', '/b', '/c'))
T, ONES = np.arange(4.0), np.ones(4)
FIELD = 1e-8 * np.ones((4, 3, 3))


def log_of_track():
    estimate = np.zeros(3), np.eye(2)
    return TrackLog(1, stamp_ns=[0, 1, 2, 3], position=[np.ones(3) * k for k in range(4)],
                    covariance=[np.eye(6)] * 4, ambiguous=[True, False, False, False],
                    arrivals=[{name: (0.5, *estimate) for name in NAMES}] * 4,
                    measured=list(FIELD), predicted=list(FIELD))


def fitted_pass():
    data = SimpleNamespace(network=NETWORK, t=np.arange(12.0), sensor=np.arange(12) % 3,
                           field=FIELD.reshape(12, 3), sensors=np.arange(3),
                           covariance=np.repeat(1e-18 * np.eye(3)[None], 12, axis=0))
    return SimpleNamespace(n_dipoles=1, data=data, names=tuple('abcd'), x=ONES,
                           predicted=data.field,
                           predicted_std=1e-9 * np.ones((12, 3)), normalised_cost=1.0)


def plan():
    lanes = [SimpleNamespace(name=name, along=T, filter_std=(k + 1.0) * ONES,
                             pass_std=ONES[:, None], detection=ONES)
             for k, name in enumerate(NAMES)]
    return SimpleNamespace(x=T, lanes=lanes, miss_curve=np.stack([T, 0.1 * ONES], axis=1))


def calibration():
    survey = SimpleNamespace(network=NETWORK, shocks={name: (T, T) for name in NAMES})
    return SimpleNamespace(network=NETWORK, survey=survey, evidence=None)


def geometry():
    found = SimpleNamespace(
        position_std=np.ones((3, 3)), rotation_std=np.ones((3, 3)), gain=np.ones(3),
        gain_std=np.ones(3), sensor_residual=np.ones(3), pose_residual=ONES,
        suspect_sensors=NAMES[:1], poses=(np.ones((4, 3)), np.ones((4, 3))))
    return SimpleNamespace(nominal=NETWORK, network=NETWORK, geometry=found, rows=np.arange(4),
                           suspect_rows=(), rotation_angle=np.ones(3))


ELLIPSOID = SimpleNamespace(coverage=1.0, correct=lambda readings: readings)


@pytest.mark.parametrize('draw, label', [
    (lambda: map_figure(log_of_track(), NETWORK), 'from {} (50% at the end)'),
    (lambda: weights_figure(log_of_track()), '{}'),
    (lambda: field_figure(log_of_track(), NETWORK), '{}'),
    (lambda: pass_figure(fitted_pass(), ', '.join(NAMES)), '{}'),
    (lambda: order_figure([SimpleNamespace(recording=name, label='pass 1', fits=[fitted_pass()],
                                           chosen=None) for name in NAMES]), '{}, pass 1'),
    (lambda: lane_figure(plan()), '{}: whole pass'), (lambda: lane_figure(plan()), '{}'),
    (lambda: calibration_figure(calibration(), NETWORK), '{}'),
    (lambda: tumble_figure(dict.fromkeys(NAMES, ELLIPSOID), dict.fromkeys(NAMES, FIELD[0])), '{}'),
    (lambda: geometry_figure(geometry()), '{}')])
def test_every_figure_draws_names_literally(draw, label):
    assert {label.format(name) for name in NAMES} <= texts_of(draw())


def test_equal_lanes_share_a_curve_and_a_label():
    """If both of two equal curves were drawn, one would hide the other."""
    lanes = plan()
    lanes.lanes[2].filter_std = lanes.lanes[0].filter_std
    texts = texts_of(lane_figure(lanes))
    assert {f'{NAMES[0]} and {NAMES[2]}', NAMES[1]} <= texts and NAMES[2] not in texts


def test_the_first_pose_is_on_the_line_of_the_track():
    """The marker is at the published pose, not at the estimate for one arrival direction."""
    log = log_of_track()
    (axes,) = map_figure(log, NETWORK).axes
    lines = {line.get_label(): line.get_xydata() for line in axes.get_lines()}
    assert lines['first pose'].tolist() == [lines['track'][0].tolist()]
    # Only hypotheses with a significant weight are drawn.
    log.arrivals = [{name: (0.001, np.zeros(3), np.eye(2)) for name in NAMES}] * 4
    labels = [line.get_label() for line in map_figure(log, NETWORK).axes[0].get_lines()]
    assert not any(label.startswith('from ') for label in labels)


def test_unpaired_surrogates_in_a_file_name_are_escaped():
    assert 'a\\udcff: measured (dots), fitted (lines), 90 % bands' in texts_of(
        pass_figure(fitted_pass(), 'a\udcff'))


def test_the_title_of_a_pass_is_drawn_literally():
    title = '$\\foo$, pass 1, 1 dipole'
    assert f'{title}: measured (dots), fitted (lines), 90 % bands' in texts_of(
        pass_figure(fitted_pass(), title))
