#!/usr/bin/env bash
# bmm150 misreads the factory calibration of the BMM150: a field of 54 uT becomes 228 uT.
#
# Packages: bmm150 0.2.2
# Expected: a BMM150 whose Hall value equals its calibration value dig_xyz1 (7048) needs no
#   correction for temperature: the x field is counts * (dig_x2 + 160) / 512 + dig_x1 / 2 in uT.
#   With 150 counts, dig_x2 = 26 and dig_x1 = -1, this is 53.99 uT; dig_x1 and dig_x2 are signed
#   numbers of 8 bits, dig_xyz1 has 15 bits.
# Source: Bosch Sensortec, BMM150 Sensor API 2.0.0 (bmm150.c, types and compensation of the trim
#   registers), on which the package is based; with equal values all terms of the temperature
#   vanish.
# Seen: 227.7 uT: "& 0x7F << 8" is taken as & 0x7F00, so dig_xyz1 keeps its low byte only (136), and
#   -1 is read as 255. Each of the two alone gives 100.2 and 182.0 uT. With positive values and
#   dig_xyz1 below 256 the result is right.
#
# Exits with 0 while the package behaves as seen, and with another status otherwise.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -I -m pip install --quiet --disable-pip-version-check \
    bmm150==0.2.2 smbus2==0.4.3 enum-tools==0.9.0.post1
cd "$folder"
venv/bin/python -I - <<'EOF'
import sys

import smbus2


class Bus:
    """SMBus with one chip: 256 registers."""

    registers = bytearray(256)

    def __init__(self, number=1):
        pass

    def read_byte_data(self, address, register):
        return self.registers[register]

    def write_byte_data(self, address, register, value):
        self.registers[register] = int(value)

    def read_i2c_block_data(self, address, register, length):
        return list(self.registers[register:register + length])

    def write_i2c_block_data(self, address, register, values):
        self.registers[register:register + len(values)] = bytes(values)


smbus2.SMBus = Bus
import bmm150


def field_x(dig_x1, dig_x2, dig_xyz1):
    """Field of 150 counts on x; the Hall value equals dig_xyz1."""
    r = Bus.registers
    r[0x40], r[0x5D], r[0x64] = 0x32, dig_x1 & 0xFF, dig_x2 & 0xFF
    r[0x6C:0x6E] = dig_xyz1.to_bytes(2, 'little')
    # Factors of the correction for temperature, as a chip has them.
    r[0x70], r[0x71] = 0xFD, 29
    r[0x42:0x44] = (150 << 3).to_bytes(2, 'little')
    r[0x48:0x4A] = (dig_xyz1 << 2).to_bytes(2, 'little')
    return bmm150.BMM150().read_mag_data()[0]


seen = []
for values in [(-1, 26, 7048), (0, 26, 7048), (-1, 26, 200), (0, 26, 200)]:
    dig_x1, dig_x2, dig_xyz1 = values
    seen.append(field_x(*values))
    print('dig_x1 %d, dig_x2 %d, dig_xyz1 %d: expected %.2f uT, got %.2f' % (
        *values, 150 * (dig_x2 + 160) / 512 + dig_x1 / 2, seen[-1]))
wrong = [abs(b - e) > 1 for b, e in zip(seen, (53.99, 54.49, 53.99, 54.49))]
if wrong != [True, True, True, False]:
    sys.exit('the behaviour has changed')
EOF
