#!/usr/bin/env bash
# The SparkFun driver of the MMC5983MA loses the bits of all but its last setting.
#
# Packages: sparkfun-qwiic-mmc5983ma 2.0.0
# Expected: set_filter_bandwidth(400) writes 10 to the bits BW of the register Internal Control 1,
#   and get_filter_bandwidth() returns 400. After set_continuous_mode_frequency(100) and
#   enable_continuous_mode() the chip measures at 100 Hz: CM_FREQ is 101, CMM_EN is 1, so Internal
#   Control 2 is 0x0D, and is_continuous_mode_enabled() is True.
# Source: data sheet of the MMC5983MA, Rev A (2019), registers 0x0A and 0x0B; descriptions of the
#   methods.
# Seen: Internal Control 1 is 1 (200 Hz), the bandwidth reads back as 100; Internal Control 2 is 8,
#   so continuous measurement is enabled with its frequency off, and reads back as disabled. The
#   driver changes a copy of its number instead of the number that it keeps, so each write contains
#   one bit only.
#
# Exits with 0 while the package behaves as seen, and with another status otherwise.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -I -m pip install --quiet --disable-pip-version-check \
    sparkfun-qwiic-mmc5983ma==2.0.0 sparkfun-qwiic-i2c==2.0.0
cd "$folder"
venv/bin/python -I - <<'EOF'
import sys

import qwiic_mmc5983ma


class Chip:
    """I2C driver with one MMC5983MA, whose measurements are always finished."""

    def __init__(self):
        self.registers = bytearray(256)
        self.registers[0x2F], self.registers[0x08] = 0x30, 0x11
        for k in (0, 2, 4):
            self.registers[k] = 0x80

    def isDeviceConnected(self, address):
        return True

    def readByte(self, address, register):
        return self.registers[register]

    def readBlock(self, address, register, length):
        return list(self.registers[register:register + length])

    def writeByte(self, address, register, value):
        self.registers[register] = value


chip = Chip()
sensor = qwiic_mmc5983ma.QwiicMMC5983MA(i2c_driver=chip)
sensor.begin()
sensor.set_filter_bandwidth(400)
bandwidth = chip.registers[0x0A], sensor.get_filter_bandwidth()
print('bandwidth 400 Hz: register 0x0A expected 0x02, got %#04x; reads back as %d Hz' % bandwidth)
sensor.set_continuous_mode_frequency(100)
sensor.enable_continuous_mode()
mode = chip.registers[0x0B], sensor.is_continuous_mode_enabled()
print('continuous at 100 Hz: register 0x0B expected 0x0d, got %#04x; enabled: %s' % mode)
if (bandwidth, mode) != ((0x01, 100), (0x08, False)):
    sys.exit('the behaviour has changed')
EOF
