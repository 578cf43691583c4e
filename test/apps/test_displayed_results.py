"""Results as tables, pages of a notebook and figures."""

import numpy as np
import pandas as pd
import pytest

import mag_tracking as mt
from support.bundled import NETWORK_FILE, QUICK, vehicle_path

PATH = vehicle_path('straight_car_right')


@pytest.fixture(scope='module', params=['track', 'traffic', 'events', 'fit'])
def result(request):
    return getattr(mt, request.param)(PATH, NETWORK_FILE, settings=QUICK)


def test_every_result_is_shown_as_table_page_and_figure(result):
    table = result.to_dataframe()
    assert len(table) and table.attrs['units']
    if not isinstance(result, mt.FitResult):
        assert str(table.index.dtype) == 'datetime64[ns, UTC]'
        assert table.index.is_monotonic_increasing or isinstance(result, mt.EventsResult)
    page = result._repr_html_()
    assert '<table' in page and len(repr(result)) < 200
    assert result.figure().get_axes()


def test_results_without_targets_have_empty_tables_and_figures():
    quiet = mt.read_recording(PATH, NETWORK_FILE).readings
    quiet = quiet.part(quiet.stamp_ns < quiet.stamp_ns[0] + 4_000_000_000)
    for run in (mt.track, mt.traffic, mt.events, mt.fit):
        found = run(quiet, NETWORK_FILE)
        assert len(found.to_dataframe()) == 0 and '<table' in found._repr_html_()
    for run in (mt.traffic, mt.events):
        assert run(quiet, NETWORK_FILE).figure().get_axes()
    for run in (mt.track, mt.fit):
        with pytest.raises(mt.UnknownTrackError):
            run(quiet, NETWORK_FILE).figure()


def test_a_page_needs_no_pandas(result, monkeypatch):
    monkeypatch.setitem(__import__('sys').modules, 'pandas', None)
    assert result._repr_html_() == f'<p>{__import__("html").escape(repr(result))}</p>'


def test_arrays_become_a_table_and_a_figure_in_six_lines(tmp_path):
    readings = mt.read_recording(PATH, NETWORK_FILE).readings
    names = np.array(readings.sensor_names())
    sensors = {name: (readings.stamp_ns[names == name], readings.field[names == name])
               for name in readings.names}
    result = mt.track(sensors, NETWORK_FILE)
    table = result.to_dataframe()
    result.figure().savefig(tmp_path / 'pass.png')
    assert isinstance(table, pd.DataFrame) and table['speed' if 'speed' in table else 'vx'].any()
    assert (tmp_path / 'pass.png').stat().st_size > 10_000
