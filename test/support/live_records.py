"""Frames and poses as published by a tracker, for tests of live pages."""

from dataclasses import replace

from mag_tracking.pipeline import Pipeline, settings_for
from mag_tracking.recording.reader import Recording
from mag_tracking.recording.sample_reader import SampleReader
from mag_tracking.records import FieldFrame, Track
from support.bundled import QUICK, vehicle_path

NS = 1_000_000_000


def records_of(name, network):
    """Frames and tracks of a recording, in chronological order."""
    pipeline, out = Pipeline(network, settings_for('vehicle', QUICK)), []
    for readings in SampleReader(Recording(vehicle_path(name)), network).readings():
        out += pipeline.feed(readings)
    return [r for r in [*out, *pipeline.flush()] if isinstance(r, (FieldFrame, Track))]


def feed(scene, records):
    for record in records:
        if isinstance(record, FieldFrame):
            scene.add_frame(record)
        else:
            scene.add_track(record)


def poses(records):
    return [r for r in records if isinstance(r, Track) and not r.ended]


def delayed_records(records, seconds):
    """Copy records with timestamps later by `seconds`."""
    return [replace(r, stamp_ns=r.stamp_ns + round(seconds * NS)) for r in records]
