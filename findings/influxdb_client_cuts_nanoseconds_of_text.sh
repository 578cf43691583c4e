#!/usr/bin/env bash
# influxdb-client 1.50.0 cuts the nanoseconds of a time that is given as text.
#
# Expected: the time 2026-11-29T02:40:00.123456789Z of a point is written with its nanoseconds, the
# default precision of the database and of this client, or is refused.
# Seen: ...123456000. The same time as an integer keeps all digits. Two readings within a
# microsecond become one point, of which only the later one is kept.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check influxdb-client==1.50.0
"$folder/venv/bin/python" - "$folder" <<'END'
from importlib.metadata import version

from influxdb_client import Point

print('influxdb-client', version('influxdb-client'))
lines = [Point('mag').field('x', 1.0).time(time).to_line_protocol()
         for time in (1795920000123456789, '2026-11-29T02:40:00.123456789Z')]
print('\n'.join(lines))
assert lines == ['mag x=1 1795920000123456789', 'mag x=1 1795920000123456000']
END
