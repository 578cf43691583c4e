"""Tables of an archive: every reader returns the values that were written."""

import duckdb
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from mag_tracking.results.archive_folder import TABLES, common_columns
from mag_tracking.results.parquet_table import TableWriter

STAMPS_NS = [1_789_000_000_123_456_789, 1_789_000_000_123_456_999, 1_789_003_600_000_000_001]
"""Two timestamps within one microsecond, and one in another hour."""


@pytest.fixture
def poses(tmp_path):
    """File of three poses, of which one has a covariance."""
    path = tmp_path / 'poses.parquet'
    with TableWriter(path, TABLES['poses']) as table:
        for k, stamp_ns in enumerate(STAMPS_NS):
            covariance = {'covariance': list(range(36))} if k == 1 else {}
            table.add({**common_columns(tmp_path / 'a.mcap', stamp_ns), 'x': 0.1 * k, **covariance})
    return path


def test_readers_keep_the_nanoseconds(poses):
    frame = pd.read_parquet(poses)
    assert frame['time'].astype('int64').tolist() == frame['stamp_ns'].tolist() == STAMPS_NS
    assert pq.read_table(poses)['time'].cast('int64').to_pylist() == STAMPS_NS
    assert duckdb.sql(f"SELECT epoch_ns(time) FROM '{poses}'").fetchall() \
        == [(stamp_ns,) for stamp_ns in STAMPS_NS]
    assert duckdb.sql(f"SELECT a.x, b.x FROM '{poses}' a JOIN '{poses}' b USING (time) "
                      'ORDER BY ALL').fetchall() == [(0.1 * k, 0.1 * k) for k in range(3)]


@pytest.mark.parametrize('expression, values', [
    ("date_trunc('hour', time)", 2), ("time_bucket(INTERVAL '15 minutes', time)", 2),
    ('hour(time)', 2), ('time::DATE', 1), ("strftime(time, '%H:%M')", 2), ('epoch(time)', 2)])
def test_functions_of_times_are_available(poses, expression, values):
    assert len(duckdb.sql(f"SELECT DISTINCT {expression} FROM '{poses}'").fetchall()) == values


def test_an_unknown_covariance_is_nan(poses):
    """A null in such a column makes the whole column unreadable in pyarrow 25."""
    expected = [[np.nan] * 36, list(range(36)), [np.nan] * 36]
    np.testing.assert_array_equal(pq.read_table(poses)['covariance'].to_pylist(), expected)
    np.testing.assert_array_equal(np.stack(pd.read_parquet(poses)['covariance']), expected)
    column = duckdb.sql(f"SELECT covariance FROM '{poses}'").fetchall()
    np.testing.assert_array_equal([row[0] for row in column], expected)
