"""Track magnetic targets and estimate their poses with a network of stationary magnetometers.

The names in `__all__` are the public Python interface (the gallery has more examples):

    import mag_tracking as mt

    result = mt.track('recording.mcap', 'network.yaml')
    result.poses['position'], result.poses['covariance']
    result.to_dataframe()
    result.figure()
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mag_tracking.analysis.fitted_pass import FittedPass
    from mag_tracking.analysis.placement import PlannedTarget, Sampling
    from mag_tracking.apps.fit import FitResult, fit
    from mag_tracking.apps.plan import Plan, plan
    from mag_tracking.apps.readings import RecordedReadings, read_recording, readings_from_arrays
    from mag_tracking.apps.track import TrackingResult, track
    from mag_tracking.apps.traffic import EventsResult, TrafficResult, events, traffic
    from mag_tracking.errors import (
        MagTrackingError,
        MissingDependencyError,
        NetworkError,
        ReadingsError,
        RecordingError,
        SettingsError,
        UnknownTrackError,
    )
    from mag_tracking.network import SensorNetwork
    from mag_tracking.network.file import read_network
    from mag_tracking.records import Readings
    from mag_tracking.run import RunReport
    from mag_tracking.settings import read_parameter_file

__version__: str
__all__ = [
    'EventsResult', 'FitResult', 'FittedPass', 'MagTrackingError', 'MissingDependencyError',
    'NetworkError', 'Plan', 'PlannedTarget', 'Readings', 'ReadingsError', 'RecordedReadings',
    'RecordingError', 'RunReport', 'Sampling', 'SensorNetwork', 'SettingsError', 'TrackingResult',
    'TrafficResult', 'UnknownTrackError', 'events', 'fit', 'plan', 'read_network',
    'read_parameter_file', 'read_recording', 'readings_from_arrays', 'track', 'traffic']

# Public names by module. The modules are imported on first use, because every command and node
# imports `mag_tracking` at startup, and the compiled code and the figures take seconds to load.
_MODULES = {
    'analysis.fitted_pass': ('FittedPass',),
    'analysis.placement': ('PlannedTarget', 'Sampling'),
    'apps.fit': ('FitResult', 'fit'),
    'apps.plan': ('Plan', 'plan'),
    'apps.readings': ('RecordedReadings', 'read_recording', 'readings_from_arrays'),
    'apps.track': ('TrackingResult', 'track'),
    'apps.traffic': ('EventsResult', 'TrafficResult', 'events', 'traffic'),
    'errors': ('MagTrackingError', 'MissingDependencyError', 'NetworkError', 'ReadingsError',
               'RecordingError', 'SettingsError', 'UnknownTrackError'),
    'network': ('SensorNetwork',),
    'network.file': ('read_network',),
    'records': ('Readings',),
    'run': ('RunReport',),
    'settings': ('read_parameter_file',)}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


if not TYPE_CHECKING:  # Type checkers use the imports above and report all other names as errors.
    def __getattr__(name: str) -> object:
        """Import a public name on first use (PEP 562)."""
        if name == '__version__':
            # The version is set only in package.xml and is read from the installed metadata.
            return importlib.import_module('importlib.metadata').version(__name__)
        if name not in _MODULE_OF:
            raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
        module = importlib.import_module(f'{__name__}.{_MODULE_OF[name]}')
        value = globals()[name] = getattr(module, name)
        return value


def __dir__() -> list[str]:
    """Return all names of the module, including public names that are not imported yet."""
    return sorted({*globals(), *__all__})
