#!/usr/bin/env bash
# python-can 4.6.1: a CAN log in the format ASC loses its date on reading, and up to a millisecond.
#
# Expected: messages that are written to a log and read again have their times, as with the formats
# BLF, CSV, candump and TRC of the same library (to a microsecond).
# Seen: read from ASC, the first message has the time 0: times are relative by default. With
# relative_timestamp=False they are up to 1 ms early, because the header holds milliseconds only and
# the rest of the first time is dropped. Recordings of several buses, begun at different times, are
# thus shifted against each other by up to a millisecond, or by the whole difference of their starts.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check python-can==4.6.1
"$folder/venv/bin/python" - "$folder" <<'END'
import sys
from importlib.metadata import version

import can

print('python-can', version('python-can'))
start = 1795920000.123456
times = [start + 0.01 * k for k in range(3)]


def read_again(suffix, **options):
    path = f'{sys.argv[1]}/log.{suffix}'
    with can.Logger(path) as log:
        for time in times:
            log(can.Message(timestamp=time, arbitration_id=0x123, data=[1, 2], is_extended_id=False))
    with can.LogReader(path, **options) as messages:
        return [message.timestamp for message in messages]


for suffix in ('blf', 'csv', 'log', 'trc'):
    error = max(abs(a - b) for a, b in zip(read_again(suffix), times, strict=True))
    print(f'{suffix}: largest error {1e6 * error:.1f} us')
    assert error < 2e-6
default, absolute = read_again('asc'), read_again('asc', relative_timestamp=False)
print(f'asc: first time {default[0]}, absolute: {1e6 * (absolute[0] - start):.0f} us')
assert default[0] == 0.0
assert -0.00047 < absolute[0] - start < -0.00044
END
