"""Passes and fits of readings that are fed as by live sensors, without a prescan."""

from mag_tracking.apps.fit import PassCollector, PassFitter
from mag_tracking.pipeline import Pipeline, Step, settings_for
from mag_tracking.records import Readings


def steps_of(pipeline, batches):
    """Yield the steps of a pipeline that is fed with batches of readings."""
    for readings in batches:
        yield Step(readings, None, pipeline.feed(readings))
    yield Step(Readings.joined([]), None, pipeline.drain())
    yield Step(Readings.joined([]), None, pipeline.close(), is_last=True)


def passes_of(network, batches, pipeline=None):
    """Collect the passes in batches of readings; return [(PassData, notes)]."""
    if pipeline is None:
        pipeline = Pipeline(network, settings_for('vehicle'), 'detect')
    collector = PassCollector(pipeline)
    return [one for step in steps_of(pipeline, batches) for one in collector.passes(step)]


def fits_of(network, readings, orders, name='world', stopped=None):
    """Fit the passes in readings; return [FittedPass]."""
    pipeline, found = Pipeline(network, settings_for('vehicle'), 'track'), []
    fitter = PassFitter(name, pipeline, orders, None, found.append, stopped)
    for step in steps_of(pipeline, [readings]):
        fitter.add(step)
    return found
