#!/usr/bin/env bash
# The CircuitPython driver of the LSM303DLH assumes a gain that it does not set.
#
# Packages: adafruit-circuitpython-lsm303dlh-mag 1.1.28
# Expected: a new instance returns the field of the chip, whatever a program did before: 500 counts
#   on x in the range of 8.1 gauss (230 counts per gauss) are 217 uT. An axis over its range (-4096
#   counts) is not a field. `mag_rate` is that of the chip.
# Source: data sheet of the LSM303DLHC, DocID018771 Rev 2 (2013), registers CRA_REG_M and CRB_REG_M;
#   overflow of the registers: as for the HMC5883L, whose registers the chip has.
# Seen: after a restart of the program without a loss of power the chip is still at 8.1 gauss, but
#   the constructor takes 1.3 gauss (1100 counts per gauss) without writing it: 45.5 uT, an
#   inconspicuous field of the Earth. An axis over its range reads -372.4 uT. `mag_rate` says 0
#   (0.75 Hz), the chip measures at 15 Hz after power-up.
#
# Exits with 0 while the package behaves as seen, and with another status otherwise.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -I -m pip install --quiet --disable-pip-version-check \
    adafruit-circuitpython-lsm303dlh-mag==1.1.28 Adafruit-Blinka==10.0.0 adafruit-circuitpython-busdevice==5.2.17 \
    adafruit-circuitpython-register==1.13.0
cd "$folder"
venv/bin/python -I - <<'EOF'
import sys


class Bus:
    """I2C bus of CircuitPython with one chip: 256 registers with auto-increment."""

    def __init__(self, registers, on_read=None, on_write=None):
        self.registers, self.pointer = registers, 0
        self.on_read, self.on_write = on_read, on_write

    def try_lock(self):
        return True

    def unlock(self):
        pass

    def writeto(self, address, buffer, *, start=0, end=None):
        data = bytes(buffer[start:end])
        if data:
            self.pointer = data[0]
        for value in data[1:]:
            self.registers[self.pointer] = value
            if self.on_write:
                self.on_write(self.pointer, value)
            self.pointer += 1

    def readfrom_into(self, address, buffer, *, start=0, end=None):
        for k in range(len(buffer))[start:end]:
            if self.on_read:
                self.on_read(self.pointer)
            buffer[k] = self.registers[self.pointer % 256]
            self.pointer += 1

    def writeto_then_readfrom(self, address, out_buffer, in_buffer, *, out_start=0, out_end=None,
                              in_start=0, in_end=None):
        self.writeto(address, out_buffer, start=out_start, end=out_end)
        self.readfrom_into(address, in_buffer, start=in_start, end=in_end)


import adafruit_lsm303dlh_mag as driver

# After power-up: 15 Hz, 1.3 gauss.
chip = Bus(bytearray(256))
chip.registers[0:3] = 0x10, 0x20, 0x03
first = driver.LSM303DLH_Mag(chip)
rate = first.mag_rate, chip.registers[0] >> 2 & 7
print('after power-up: mag_rate expected code %d, got %d' % rate[::-1])
first.mag_gain = driver.MAGGAIN_8_1
chip.registers[3:5] = (500).to_bytes(2, 'big')
before = first.magnetic[0]
after = driver.LSM303DLH_Mag(chip).magnetic[0]
print('500 counts at 8.1 gauss: before the restart %.1f uT, after it %.1f uT' % (before, after))
chip.registers[3:5] = (-4096).to_bytes(2, 'big', signed=True)
over = driver.LSM303DLH_Mag(chip).magnetic[0]
print('x over its range (-4096 counts): expected no field, got %.1f uT' % over)
if rate != (0, 4) or [round(b, 1) for b in (before, after, over)] != [217.4, 45.5, -372.4]:
    sys.exit('the behaviour has changed')
EOF
