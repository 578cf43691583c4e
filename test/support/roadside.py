"""Simulated roadside in real time: two boards measure, and a vehicle passes on request.

Each board has a sample counter and a clock, and sends its readings over MQTT and a serial line at
the same time. Readings that are not received are lost. As on a real board, a lost connection is
soon re-established.
"""

import json
import socket
import threading
import time
from contextlib import suppress
from functools import reduce

import numpy as np

from mag_tracking.simulation.scenario import Path
from support.mqtt_broker import publish_packet

RATE_HZ = 100.0
NOISE = 1.2e-8
"""[T] Noise of a reading."""
INITIAL_POSITION = np.array([-20.0, -1.5])
"""[m] Initial position of a vehicle, some metres before it can be detected."""
SPEED = 6.0
PASSING_S = 8.0
"""[s] Duration of a pass. At its end, the vehicle is 28 m away and its field is below 2 nT."""
CONNECT = b'\x10\x12\x00\x04MQTT\x04\x02\x00\x00\x00\x06boards'
"""CONNECT packet (MQTT 3.1.1, section 3.1) of client `boards`: clean session, no keep-alive."""
TWIN_S = 3.0


class MqttSender:
    """Connection of the boards to a broker. After a failure, each `send` tries to reconnect."""

    def __init__(self, port):
        self._port, self._socket = port, None

    def send(self, readings):
        """Send one message per reading (board, sequence, ticks, field [nT])."""
        with suppress(OSError):
            if self._socket is None:
                self._connect()
            self._socket.sendall(b''.join(
                publish_packet(b'road/' + board.encode(), json.dumps(
                    {'n': k, 't': ticks, 'x': x, 'y': y, 'z': z}).encode())
                for board, k, ticks, (x, y, z) in readings))
            return
        self.close()

    def _connect(self):
        """Connect; raises OSError if the broker does not listen."""
        self._socket = socket.create_connection(('127.0.0.1', self._port), 1.0)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.sendall(CONNECT)

    def close(self):
        """Disconnect; may be called twice."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


def nmea_line(board, k, ticks, field):
    """Line with a reading [nT] and its NMEA 0183 checksum."""
    body = ','.join([board, str(k), str(ticks), *(f'{v:.1f}' for v in field)]).encode()
    return body + b'*%02X\n' % reduce(lambda a, b: a ^ b, body)


class Roadside:
    """Boards of a network, in their own thread; board `A` has the first sensor, `B` the second."""

    def __init__(self, network, body, port, line):
        assert len(network) == 2
        self._mqtt, self._line = MqttSender(port), line
        self._path = Path(INITIAL_POSITION, 0.0, SPEED)
        self._still = np.einsum('w,jws->js', network.earth_field, network.R_ws)
        position, heading = self._path.at(np.arange(0.0, PASSING_S, 1.0 / RATE_HZ))
        self._table = self._still + np.einsum('njw,jws->njs', body.field(
            network.earth_field, position, heading, network.positions), network.R_ws)
        self._rng = np.random.default_rng(1)
        self._start_round, self._start_ns = None, None
        # `twin`: whether a third board, switched on `TWIN_S` later, also sends as `A`.
        self.plugged, self.twin = True, False
        self._line_lock, self._stopping = threading.Lock(), threading.Event()
        self._thread = threading.Thread(target=self._measure, name='boards')

    def __enter__(self):
        self._line.plug_in()
        self._start_ns = time.time_ns()
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stopping.set()
        self._thread.join(timeout=10.0)
        self._mqtt.close()
        if self.plugged:
            self.pull_out()
        assert not self._thread.is_alive()

    def pull_out(self):
        """Remove the serial port."""
        with self._line_lock:
            self._line.pull_out()
            self.plugged = False

    def plug_in(self):
        """Restore the serial port."""
        with self._line_lock:
            self._line.plug_in()
            self.plugged = True

    def start_vehicle(self):
        """Start a vehicle; the previous vehicle must have left."""
        assert self.is_gone()
        # It starts in the next round, because the current round may have been sent in part.
        self._start_round = round((time.time_ns() - self._start_ns) / 1e9 * RATE_HZ) + 1

    def is_gone(self):
        """Whether no vehicle is passing."""
        return self._start_round is None or self._elapsed(time.time_ns()) > PASSING_S

    def truth(self, stamp_ns):
        """Position (2,) [m] of the latest vehicle, even after its pass; NaN before the first
        vehicle."""
        if self._start_round is None:
            return np.full(2, np.nan)
        return INITIAL_POSITION + [SPEED * self._elapsed(stamp_ns), 0.0]

    def _elapsed(self, stamp_ns):
        """Time [s] from the start of the latest vehicle to `stamp_ns`."""
        return (stamp_ns - self._start_ns) / 1e9 - self._start_round / RATE_HZ

    def _measure(self):
        """Send rounds of readings, each as soon as it is due."""
        k = 0
        while not self._stopping.wait(max(
                0.0, k / RATE_HZ - (time.time_ns() - self._start_ns) / 1e9)):
            row = None if self._start_round is None else k - self._start_round
            is_passing = row is not None and 0 <= row < len(self._table)
            field = self._table[row] if is_passing else self._still
            field = 1e9 * (field + NOISE * self._rng.standard_normal(field.shape))
            readings = self._readings(k, field)
            self._mqtt.send(readings)
            with self._line_lock:
                if self.plugged:
                    self._line.send(b''.join(nmea_line(*r) for r in readings))
            k += 1

    def _readings(self, k, field):
        """Readings of round `k`: [(board, sequence, ticks [µs], field [nT])]."""
        readings = [('A', k, field[0]), ('B', k, field[1])]
        if self.twin:
            readings.append(('A', k - round(TWIN_S * RATE_HZ), field[0] + 50.0))
        return [(board, n, round(1e6 * n / RATE_HZ), tuple(np.round(values, 1).tolist()))
                for board, n, values in readings]
