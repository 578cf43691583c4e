#!/usr/bin/env bash
# The CircuitPython driver of the BNO08x returns zeros at first, and then the oldest report.
#
# Packages: adafruit-circuitpython-bno08x 1.3.3
# Expected: after enable_feature(BNO_REPORT_MAGNETOMETER), `magnetic` returns the latest field, and
#   raises or waits as long as no report has arrived, as it does before the feature is enabled. Of a
#   packet with the reports of 10, 20 and 30 uT in this order, it returns 30 uT.
# Source: SH-2 Reference Manual 1000-3625 (Hillcrest): reports in a transfer are in the order of
#   their samples; text of the property.
# Seen: (0, 0, 0) before the first report, like a field; then 10 uT: the reports of a packet are
#   processed from its end, so that the oldest one remains. At 100 Hz and a program that reads at 20
#   Hz the field is 40 ms old.
#
# Exits with 0 while the package behaves as seen, and with another status otherwise.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -I -m pip install --quiet --disable-pip-version-check \
    adafruit-circuitpython-bno08x==1.3.3 Adafruit-Blinka==10.0.0 adafruit-circuitpython-busdevice==5.2.17 \
    adafruit-circuitpython-register==1.13.0
cd "$folder"
venv/bin/python -I - <<'EOF'
import struct
import sys
import time

from adafruit_bno08x import BNO_REPORT_MAGNETOMETER
from adafruit_bno08x.i2c import BNO08X_I2C


class Bus:
    """I2C bus of CircuitPython with one BNO085 that holds a queue of packets."""

    def __init__(self):
        self.packets = [(0, bytes(20)), (1, b'\x01'), (2, b'\xf1' + bytes(15))]

    def try_lock(self):
        return True

    def unlock(self):
        pass

    def writeto(self, address, buffer, *, start=0, end=None):
        data = bytes(buffer[start:end])
        channel, content = data[2:3], data[4:]
        if channel == b'\x02' and content[0] == 0xF9:
            self.packets.append((2, b'\xf8\x01\x03\x02' + bytes((1, 2, 3, 4)) + bytes(8)))
        elif channel == b'\x02' and content[0] == 0xFD:
            self.packets.append((2, b'\xfc' + content[1:17]))

    def readfrom_into(self, address, buffer, *, start=0, end=None):
        n = len(buffer[start:end])
        data = bytes(n)
        if self.packets:
            channel, content = self.packets[0]
            data = (struct.pack('<HBB', len(content) + 4, channel, 0) + content).ljust(n, b'\0')[:n]
            if n > 4:
                self.packets.pop(0)
        buffer[start:end] = data


def report(field_ut):
    return bytes((0x03, 0, 3, 0)) + struct.pack('<hhh', *[round(16 * field_ut)] * 3)


bus = Bus()
time.sleep = lambda seconds: None
sensor = BNO08X_I2C(bus)
try:
    print('before the feature is enabled:', sensor.magnetic)
except RuntimeError as error:
    print('before the feature is enabled: RuntimeError:', error)
sensor.enable_feature(BNO_REPORT_MAGNETOMETER)
first = sensor.magnetic
print('enabled, no report yet: expected no field, got', first)
bus.packets.append((3, bytes((0xFB, 0, 0, 0, 0)) + report(10) + report(20) + report(30)))
field = sensor.magnetic
print('reports of 10, 20, 30 uT in one packet: expected 30, got', field[0])
if (first, field[0]) != ((0.0, 0.0, 0.0), 10.0):
    sys.exit('the behaviour has changed')
EOF
