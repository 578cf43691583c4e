#!/usr/bin/env bash
# The Pimoroni driver of the LSM303D reads 24 % low.
#
# Packages: lsm303d 1.0.0 (i2cdevice 1.0.0)
# Expected: in its range of 2 gauss, a count of the LSM303D is 0.080 mgauss, so 6250 counts are 0.5
#   gauss. The numbers of the other ranges are 0.160, 0.320 and 0.479 mgauss.
# Source: data sheet of the LSM303D, DocID023312 (ST), sensor characteristics, magnetic sensitivity
#   M_GN.
# Seen: 0.381 gauss: the driver takes the full range of 16 bits as 2 gauss, although the chip ends
#   at 25000 counts. A field of the Earth of 50 uT becomes 38 uT, in each range.
#
# Exits with 0 while the package behaves as seen, and with another status otherwise.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -I -m pip install --quiet --disable-pip-version-check \
    lsm303d==1.0.0 i2cdevice==1.0.0 smbus2==0.5.0
cd "$folder"
venv/bin/python -I - <<'EOF'
import sys

import lsm303d


class Bus:
    """SMBus with one LSM303D that holds 6250, -6250 and 0 counts."""

    def __init__(self):
        self.registers = bytearray(256)
        self.registers[0x0F] = 0x49
        for k, count in enumerate((6250, -6250, 0)):
            self.registers[0x08 + 2 * k:0x0A + 2 * k] = count.to_bytes(2, 'little', signed=True)

    def read_i2c_block_data(self, address, register, length):
        register &= 0x7F
        return list(self.registers[register:register + length])

    def write_i2c_block_data(self, address, register, values):
        register &= 0x7F
        self.registers[register:register + len(values)] = bytes(values)


sensor = lsm303d.LSM303D(0x1D, i2c_dev=Bus())
field = sensor.magnetometer()
print('6250 counts at 0.080 mgauss: expected 0.5 gauss, got', ['%.4f' % b for b in field])
if abs(field[0] - 2 * 6250 / 32767) > 1e-9 or abs(field[0] + field[1]) > 1e-9:
    sys.exit('the behaviour has changed')
EOF
