"""Messages that encode numbers, and recordings of these messages."""

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from mag_tracking.messages.schema import stamp_ns
from mag_tracking.messages.types import MAGNETIC_FIELD, decode, definition, encoder
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.recorder import Recorder
from support.samples import MagSample, sample_dict

TOPIC = '/mag_1/imu/mag'
S = 10**9


def field(k):
    """Serialised magnetic field message with the number `k` as its timestamp."""
    noise = np.random.default_rng(k).standard_normal(3) * 1e-5
    return encoder(MAGNETIC_FIELD)(sample_dict(MagSample(k, 'mag', noise, None), 'mag_1'))


def started(folder, **arguments):
    """Start a recorder with one topic; return (recorder, list of its reports)."""
    reports = []
    recorder = Recorder(folder, report=reports.append, **arguments)
    recorder.add_topic(TOPIC, MAGNETIC_FIELD, definition(MAGNETIC_FIELD))
    recorder.tick(S)
    return recorder, reports


def numbers(path, topic=TOPIC):
    """Read a recording; return (message numbers in recorded order, recording)."""
    recording = Recording(path)
    return [stamp_ns(decode(m).header.stamp) for m in recording.messages([topic])], recording


def by_rosbags(path, topic=TOPIC):
    """Read a recording with the library `rosbags`; return [(time, number)]."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        rows = [(t, reader.deserialize(raw, c.msgtype).header.stamp)
                for c, t, raw in reader.messages() if c.topic == topic]
    return [(t, s.sec * S + s.nanosec) for t, s in rows]
