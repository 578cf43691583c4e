#!/usr/bin/env bash
# qmc5883l sets another range of the QMC5883L than the one that it uses for the scale.
#
# Packages: qmc5883l 0.92
# Expected: QMC5883L(full_scale=False) selects 2 gauss: the bits RNG (5:4) of the control register
#   0x09 are 00, a gauss is 12000 counts, so 6000 counts are 0.5 gauss. With full_scale=True RNG is
#   01 and a gauss is 3000 counts; ODR is bits 3:2 and OSR bits 7:6.
# Source: data sheet of the QMC5883L 1.0 (QST), control register and sensitivity.
# Seen: the range is written to the bits of the rate, the number of averages to those of the range,
#   and the rate to those of the averages. full_scale=False with the default of 256 averages selects
#   8 gauss but takes 6000 counts as 0.366 gauss (they are 2 gauss); full_scale=True with 512
#   averages selects 2 gauss but takes them as 1.46 gauss (they are 0.5). Besides, 32768 counts are
#   taken as the full range, which is 24000.
#
# Exits with 0 while the package behaves as seen, and with another status otherwise.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -I -m pip install --quiet --disable-pip-version-check \
    setuptools==80.9.0 qmc5883l==0.92 smbus2==0.5.0
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
import qmc5883l

Bus.registers[0x0D] = 0xFF
Bus.registers[0:6] = (6000).to_bytes(2, 'little') * 3
changed = False
for options, expected in [({'full_scale': False}, (1, 2, 0.3662)),
                          ({'full_scale': True, 'over_sampling_rate': 512}, (0, 8, 1.4648))]:
    sensor = qmc5883l.QMC5883L(**options)
    chip = Bus.registers[0x09] >> 4 & 3
    field = sensor.get_magnet()[0]
    print(options, '-> range of the chip: %d gauss; 6000 counts are %.4f gauss, got %.4f' % (
        (2, 8)[chip], 6000 / (12000, 3000)[chip], field))
    changed |= (chip, 8 if sensor.full_scale else 2, round(field, 4)) != expected
if changed:
    sys.exit('the behaviour has changed')
EOF
