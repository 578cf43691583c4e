#!/usr/bin/env bash
# circuitpython-qmc5883l waits until the chip has lost a measurement.
#
# Packages: circuitpython-qmc5883l 0.1.3
# Expected: `magnetic` returns as soon as the bit DRDY (bit 0 of register 0x06) says that a
#   measurement is ready: within 5 ms at 200 Hz. Its unit is microtesla, as in all drivers for
#   CircuitPython.
# Source: data sheet of the QMC5883L 1.0 (QST), status register (DRDY, OVL, DOR); CircuitPython
#   design guide, sensor properties.
# Seen: it waits for bit 2, DOR: a measurement was overwritten before it was read. Each reading
#   takes 10 ms at 200 Hz, every second measurement is lost, and the result is in gauss.
#
# Exits with 0 while the package behaves as seen, and with another status otherwise.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -I -m pip install --quiet --disable-pip-version-check \
    circuitpython-qmc5883l==0.1.3 Adafruit-Blinka==10.0.0 adafruit-circuitpython-busdevice==5.2.17 \
    adafruit-circuitpython-register==1.13.0
cd "$folder"
venv/bin/python -I - <<'EOF'
import sys
import time


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


class Qmc5883l(Bus):
    """QMC5883L at 200 Hz in a field of 0.5 gauss on its x axis, with a simulated time in ms."""

    def __init__(self):
        super().__init__(bytearray(256), on_read=self.update)
        self.registers[0x0D] = 0xFF
        self.registers[0:2] = (6000).to_bytes(2, 'little')
        self.ms = self.read_ms = 0

    def update(self, register):
        n_new = (self.ms - self.read_ms) // 5
        self.registers[0x06] = min(n_new, 1) | (n_new > 1) << 2
        if register == 0x05:
            self.read_ms = self.ms


bus = Qmc5883l()


def sleep(seconds):
    bus.ms += max(1, round(1e3 * seconds))


time.sleep = sleep
import qmc5883l

sensor = qmc5883l.QMC5883L(bus)
times = []
for _ in range(5):
    start, field = bus.ms, sensor.magnetic
    times.append(bus.ms - start)
print('time of a reading: expected 5 ms, got', times, 'ms')
print('6000 counts in the range of 2 gauss: expected 50 uT, got', field[0])
if times[1:] != [10] * 4 or field[0] != 0.5:
    sys.exit('the behaviour has changed')
EOF
