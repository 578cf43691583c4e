"""The errors that a caller can act on; each message names the thing, the value and the bound."""


class MagTrackingError(Exception):
    """Base of all errors that this package raises on purpose."""


class SettingsError(MagTrackingError):
    """A setting has an unknown name, a wrong type, or a value out of range."""


class NetworkError(MagTrackingError):
    """The network file does not describe a usable network."""


class RecordingError(MagTrackingError):
    """A recording cannot be read, or does not hold what is needed."""


class OutputError(MagTrackingError):
    """A result cannot be written where it was asked for."""


class DeviceError(MagTrackingError):
    """A device cannot be opened or read: a port, a socket, a broker or a bus."""


class ReadingsError(MagTrackingError, ValueError):
    """Arrays of readings have a wrong shape, type or order."""


class UnknownTrackError(MagTrackingError, LookupError):
    """A result has no track with this number."""


class MissingDependencyError(MagTrackingError, ImportError):
    """An optional package is not installed."""


class GraphError(MagTrackingError):
    """A topic, service or node of the ROS graph is missing, refuses, or does not answer."""


class ClusterError(MagTrackingError):
    """A Dask scheduler does not answer, has no worker, or is gone."""


class LabelsError(MagTrackingError):
    """Labelled examples are missing, overlap, or are too few to learn from."""
