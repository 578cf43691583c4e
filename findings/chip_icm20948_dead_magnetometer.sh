#!/usr/bin/env bash
# The CircuitPython driver of the ICM-20948 reads (0, 0, 0) from a magnetometer that is not there.
#
# Packages: adafruit-circuitpython-icm20x 2.1.10
# Expected: if the AK09916 in the chip does not answer on the internal bus (SLV4_DONE is never set),
#   the constructor raises, as it does for a wrong identity of the ICM-20948;
#   `magnetometer_data_rate` returns the rate that was set.
# Source: data sheet of the ICM-20948, DS-000189 (TDK), register I2C_MST_STATUS; text of the
#   property and of its setter.
# Seen: no error: the result of the initialisation is not looked at, and `magnetic` is (0.0, 0.0,
#   0.0) at each reading. `magnetometer_data_rate` is None, also with a magnetometer that answers:
#   the getter returns nothing.
#
# Exits with 0 while the package behaves as seen, and with another status otherwise.
set -euo pipefail

folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -I -m pip install --quiet --disable-pip-version-check \
    adafruit-circuitpython-icm20x==2.1.10 Adafruit-Blinka==10.0.0 adafruit-circuitpython-busdevice==5.2.17 \
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


class Icm20948(Bus):
    """ICM-20948 with four banks of registers; its magnetometer answers or not."""

    def __init__(self, answers):
        self.banks = [bytearray(256) for _ in range(4)]
        self.answers = answers
        super().__init__(self.banks[0], on_write=self.written)
        self.banks[0][0x00] = 0xEA
        if answers:
            # 333 counts of 0.15 uT on x.
            self.banks[0][0x3B:0x3D] = (333).to_bytes(2, 'little')

    def written(self, register, value):
        if register == 0x7F:
            self.registers = self.banks[value >> 4 & 3]
        elif register == 0x06:
            self.registers[0x06] &= 0x7F
        elif self.registers is self.banks[3] and register == 0x15 and self.answers:
            # Bit 6 of I2C_MST_STATUS: the transfer to the magnetometer is finished.
            self.banks[0][0x17] |= 0x40


time.sleep = lambda seconds: None
import adafruit_icm20x

adafruit_icm20x.sleep = time.sleep
seen = []
for answers in (True, False):
    sensor = adafruit_icm20x.ICM20948(Icm20948(answers))
    seen.append((sensor.magnetic, sensor.magnetometer_data_rate))
    print('magnetometer answers: %-5s -> magnetic %s, data rate %s' % (answers, *seen[-1]))
print('expected: an error if it does not answer; a data rate of 100 Hz if it does')
if seen[1] != ((0.0, 0.0, 0.0), None) or seen[0][1] is not None:
    sys.exit('the behaviour has changed')
EOF
