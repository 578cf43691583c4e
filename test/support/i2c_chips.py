"""Simulated magnetometer chips that follow their data sheets register by register.

They are independent of the drivers. Behaviour that a data sheet does not guarantee is not
simulated.
"""

import math

GAUSS = 1e-4
MS = 1_000_000


class Clock:
    """Clock that advances only by `sleep` and by bus transactions."""

    def __init__(self):
        self.ns = 5_000_000_000

    def monotonic_ns(self):
        return self.ns

    def sleep(self, seconds):
        assert seconds >= 0.0
        self.ns += math.ceil(seconds * 1e9)


class FakeChip:
    """Chip with an auto-incremented register pointer; `field` [T] may depend on the time [ns]."""

    def __init__(self, clock, field=(2e-5, -1e-5, 4e-5)):
        self.clock = clock
        self.field = field if callable(field) else lambda ns: field
        self.answers = True
        self.written = []
        self.power_up()

    def power_up(self):
        self.memory = bytearray(256)
        self.pointer = 0
        self.reset()

    def reset(self):
        """Restore the default values of the registers."""

    def write(self, data):
        if data:
            self.pointer = data[0]
        for value in data[1:]:
            self.written.append((self.pointer, value))
            self.store(self.pointer, value)
            self.advance()

    def read(self, length):
        out = []
        for _ in range(length):
            out.append(self.fetch(self.pointer))
            self.advance()
        return bytes(out)

    def advance(self):
        self.pointer = (self.pointer + 1) % 256

    def store(self, register, value):
        self.memory[register] = value

    def fetch(self, register):
        return self.memory[register]


class FakeMmc5983ma(FakeChip):
    """MMC5983MA: 18 bits about 131072, 16384 counts per gauss, bridge offset in counts."""

    ID, STATUS, DONE, CONTROL = (0x2F, 0x30), 0x08, 0x01, 0x09
    RESET_MS, CONVERSION_MS = 10, (8.0, 4.0, 2.0, 0.5)
    MIDDLE, COUNTS_PER_GAUSS = 1 << 17, 16384
    bridge_offset = (0.0, 0.0, 0.0)

    def reset(self):
        self.memory[self.ID[0]] = self.ID[1]
        # This bit means that the chip has loaded its calibration from its memory.
        self.memory[self.STATUS] = 0x10
        self.polarity = 0
        self.ready_ns = self.pulse_ns = 0
        self.end_ns = None
        self.pulses = []

    def store(self, register, value):
        now = self.clock.ns
        if now < self.ready_ns:
            return
        if register == self.CONTROL + 1:
            if value & 0x80:
                self.memory = bytearray(256)
                pulses = self.pulses
                self.reset()
                self.pulses = pulses
                self.ready_ns = now + self.RESET_MS * MS
            else:
                self.memory[register] = value
        elif register == self.CONTROL:
            assert value in (0x01, 0x08, 0x10), 'only one command may be given at a time'
            if value != 0x01:
                # After RESET, the axes point as drawn in the data sheet.
                self.polarity, self.pulse_ns = (-1 if value == 0x08 else 1), now
                self.pulses.append((now, value))
            elif now >= self.pulse_ns + MS and not self.memory[self.CONTROL + 2]:
                bandwidth = self.memory[self.CONTROL + 1] & 3
                self.start_ns = now
                self.end_ns = now + round(self.CONVERSION_MS[bandwidth] * MS)
                self.memory[self.STATUS] &= ~self.DONE

    def fetch(self, register):
        if self.end_ns is not None and self.clock.ns >= self.end_ns:
            self.finish()
        if self.CONTROL <= register <= self.CONTROL + 3:
            return 0
        return self.memory[register]

    def finish(self):
        field = self.field((self.start_ns + self.end_ns) // 2)
        counts = [self.MIDDLE + self.polarity * b / GAUSS * self.COUNTS_PER_GAUSS + o
                  for b, o in zip(field, self.bridge_offset, strict=True)]
        self.put([min(max(round(c), 0), 2 * self.MIDDLE - 1) for c in counts])
        self.memory[self.STATUS] |= self.DONE
        self.end_ns = None

    def put(self, counts):
        self.memory[6] = 0
        for i, c in enumerate(counts):
            self.memory[2 * i], self.memory[2 * i + 1] = c >> 10, c >> 2 & 0xFF
            self.memory[6] |= (c & 3) << (6, 4, 2)[i]


class FakeMmc5603(FakeMmc5983ma):
    """MMC5603: 20 bits about 524288, 16384 counts per gauss."""

    ID, STATUS, DONE, CONTROL = (0x39, 0x10), 0x18, 0x40, 0x1B
    RESET_MS, CONVERSION_MS = 20, (6.6, 3.5, 2.0, 1.2)
    MIDDLE = 1 << 19

    def put(self, counts):
        for i, c in enumerate(counts):
            self.memory[2 * i], self.memory[2 * i + 1] = c >> 12, c >> 4 & 0xFF
            self.memory[6 + i] = (c & 15) << 4


class FakeHmc5883l(FakeChip):
    """HMC5883L in single-measurement mode; a change of gain takes effect one measurement later."""

    GAINS = (1370, 1090, 820, 660, 440, 390, 330, 230)

    def reset(self):
        self.memory[0:3] = 0x10, 0x20, 0x01
        self.memory[10:13] = b'H43'
        self.gain = self.GAINS[1]
        self.end_ns = None

    def store(self, register, value):
        self.finish()
        if register <= 2:
            self.memory[register] = value
        if register == 2 and value & 3 == 1:
            self.start_ns, self.end_ns = self.clock.ns, self.clock.ns + 6 * MS

    def advance(self):
        # After the last output register, the pointer returns to the first one.
        self.pointer = 3 if self.pointer == 8 else (self.pointer + 1) % 13

    def fetch(self, register):
        self.finish()
        return self.memory[register]

    def finish(self):
        if self.end_ns is None or self.clock.ns < self.end_ns:
            return
        # The self-test adds a bias.
        bias = 1.16 * GAUSS if self.memory[0] & 3 else 0.0
        x, y, z = (b + bias for b in self.field((self.start_ns + self.end_ns) // 2))
        for i, b in enumerate((x, z, y)):
            c = round(b / GAUSS * self.gain)
            c = c if -2048 <= c <= 2047 else -4096
            self.memory[3 + 2 * i:5 + 2 * i] = c.to_bytes(2, 'big', signed=True)
        self.gain = self.GAINS[self.memory[1] >> 5]
        self.memory[2], self.memory[9] = 0x03, 0x01
        self.end_ns = None


class ContinuousChip(FakeChip):
    """Chip that measures continuously from `start_ns` on, every `period_ns`."""

    start_ns = None

    def begin(self, period_ns):
        self.start_ns, self.period_ns = self.clock.ns, period_ns
        self.taken = self.seen = 0

    def stop(self):
        self.start_ns = None

    @property
    def complete(self):
        """Number of complete conversions."""
        return 0 if self.start_ns is None else (self.clock.ns - self.start_ns) // self.period_ns

    @property
    def is_new(self):
        return self.start_ns is not None and self.complete > self.taken

    def latest(self):
        """Field (3,) [T] at the middle of the last complete conversion."""
        if not self.complete:
            return 0.0, 0.0, 0.0
        return self.field(self.start_ns + round((self.complete - 0.5) * self.period_ns))


class FakeRm3100(ContinuousChip):
    """RM3100; results are latched when their first byte is read."""

    GAIN = {50: (20.0, 534.0), 100: (38.0, 283.0), 200: (75.0, 147.0)}

    def reset(self):
        self.memory[0x04:0x0A] = bytes((0, 200)) * 3
        self.memory[0x0B], self.memory[0x36] = 0x96, 0x22
        self.stop()

    @property
    def cycles(self):
        x, y, z = (int.from_bytes(self.memory[r:r + 2], 'big') for r in (4, 6, 8))
        assert x == y == z
        return x

    def store(self, register, value):
        if self.start_ns is not None and register in range(4, 10):
            return
        if register == 0x0B:
            self.stop()
        self.memory[register] = value
        if register == 0x00:
            assert value == 0x70, 'all axes must be measured'
            self.begin(round(1e9 / self.GAIN[self.cycles][1]))
        if register == 0x01:
            self.stop()
            if value & 1:
                assert value & 0x7C == 0x78, 'all axes must be enabled, ready when all are complete'
                slowest = {0x92: 1.7 * MS, 0x96: 27 * MS}[self.memory[0x0B]]
                self.begin(max(round(1e9 / self.GAIN[self.cycles][1]), slowest))

    def fetch(self, register):
        if register == 0x01:
            self.stop()
        if register == 0x34:
            return 0x80 if self.is_new else 0x00
        if register == 0x24:
            gain = self.GAIN[self.cycles][0]
            self.memory[0x24:0x2D] = b''.join(
                round(b / 1e-6 * gain).to_bytes(3, 'big', signed=True) for b in self.latest())
            self.taken = self.complete
        return self.memory[register]


class FakeLis3mdl(ContinuousChip):
    """LIS3MDL; if `strict`, bit 7 of the register number enables auto-increment."""

    GAIN = (6842, 3421, 2281, 1711)
    strict = True
    ready_ns = 0

    def reset(self):
        self.memory[0x0F], self.memory[0x20], self.memory[0x22] = 0x3D, 0x10, 0x03
        self.memory[0x21] = self.memory[0x23] = self.memory[0x24] = 0
        self.stop()

    def advance(self):
        if self.pointer & 0x80 or not self.strict:
            self.pointer = (self.pointer + 1 & 0x7F) | self.pointer & 0x80

    def store(self, register, value):
        register &= 0x7F
        if self.clock.ns < self.ready_ns:
            return
        if register == 0x21 and value & 0x04:
            self.memory = bytearray(256)
            self.reset()
            self.ready_ns = self.clock.ns + 5 * MS
            return
        self.memory[register] = value
        if register == 0x22:
            self.stop()
            if value & 3 == 0:
                assert self.memory[0x20] & 0x62 == 0x62, 'only the fast rate is simulated'
                assert self.memory[0x23] & 0x0C == 0x0C, 'Z is in a slower mode'
                assert self.memory[0x24] & 0x40 or not self.strict, 'two conversions may be mixed'
                self.begin(round(1e9 / 155.0))

    def fetch(self, register):
        register &= 0x7F
        if register == 0x27:
            return (0x0F if self.is_new else 0) | (0xF0 if self.complete > self.taken + 1 else 0)
        if register == 0x28:
            gain = self.GAIN[self.memory[0x21] >> 5 & 3]
            self.memory[0x28:0x2E] = b''.join(
                min(max(round(b / GAUSS * gain), -32768), 32767).to_bytes(2, 'little', signed=True)
                for b in self.latest())
            self.taken = self.complete
        return self.memory[register]
