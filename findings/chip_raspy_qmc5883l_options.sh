#!/usr/bin/env bash
# raspy-qmc5883l ignores its options: the QMC5883L measures at 10 Hz in the range of 2 gauss.
#
# Packages: raspy-qmc5883l 0.3.0
# Expected: QMC5883L() with its default arguments (ODR_200HZ, RNG_8G, OSR_512) writes MODE 01, ODR
#   11, RNG 01, OSR 00 to the control register 0x09: 0x1D. get_magnet_raw() then returns 3000 counts
#   per gauss at 200 Hz.
# Source: signature of the class; data sheet of the QMC5883L 1.0 (QST), control register.
# Seen: 0x01, whatever the arguments are: 10 Hz, 2 gauss, 12000 counts per gauss. Whoever scales by
#   the range that was asked for gets a field four times too large, and readings repeat 20 times at
#   200 Hz.
#
# Exits with 0 while the package behaves as seen, and with another status otherwise.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -I -m pip install --quiet --disable-pip-version-check \
    setuptools==80.9.0 raspy-qmc5883l==0.3.0 smbus2==0.5.0
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
import raspy_qmc5883l as driver

Bus.registers[0x0D] = 0xFF
changed, sensors = False, []
for options, expected in [({}, 0x1D), ({'output_data_rate': driver.ODR_50HZ,
                                        'output_range': driver.RNG_2G}, 0x05)]:
    # The end of an instance puts the chip into standby.
    sensors.append(driver.QMC5883L(**options))
    print('%s -> control register 0x09: expected %#04x, got %#04x' % (
        options or 'defaults', expected, Bus.registers[0x09]))
    changed |= Bus.registers[0x09] != 0x01
if changed:
    sys.exit('the behaviour has changed')
EOF
