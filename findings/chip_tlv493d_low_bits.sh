#!/usr/bin/env bash
# The PyPI driver of the TLV493D drops the four low bits of each axis.
#
# Packages: TLV493D 1.0.1
# Expected: an axis of the TLV493D-A1B6 has 12 bits, 8 in one register and 4 in another, with 0.098
#   mT per count. 0x10F counts (271) are 26.56 mT, and one count more or less is 0.098 mT more or
#   less.
# Source: user manual of the TLV493D-A1B6 (Infineon), registers Bx, By, Bz, Bx2, Bz2, and
#   sensitivity.
# Seen: 25.09 mT (256 counts): a logical "or" joins the two parts, so the low one is used only if
#   the high one is 0. The field moves in steps of 1.57 mT, 31 times the field of the Earth.
#
# Exits with 0 while the package behaves as seen, and with another status otherwise.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -I -m pip install --quiet --disable-pip-version-check \
    TLV493D==1.0.1
cd "$folder"
venv/bin/python -I - <<'EOF'
import sys
from types import ModuleType


class Bus:
    """SMBus with one TLV493D-A1B6, whose three axes hold `count`."""

    count = 0

    def __init__(self, number):
        pass

    def write_byte_data(self, address, register, value):
        pass

    def read_i2c_block_data(self, address, register, length):
        high, low = self.count >> 4 & 0xFF, self.count & 15
        return [high, high, high, 0, low << 4 | low, low, 0, 0, 0, 0]


# The driver needs the module of the system for the I2C bus, and opens the bus at its import.
smbus = ModuleType('smbus')
smbus.SMBus = Bus
sys.modules['smbus'] = smbus
import TLV

sensor = TLV.TLV493D()
fields = []
for Bus.count in (0x0F, 0x10F, 0x11F):
    sensor.update_data()
    fields.append([round(b, 3) for b in (sensor.get_x(), sensor.get_y(), sensor.get_z())])
    print('%d counts: expected %.3f mT, got %s' % (Bus.count, Bus.count * 0.098, fields[-1]))
if fields != [[1.47] * 3, [25.088] * 3, [26.656] * 3]:
    sys.exit('the behaviour has changed')
EOF
