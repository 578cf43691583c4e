"""Exceptions of the package, whose messages name the object, the invalid value and its bound."""


class MagTrackingError(Exception):
    """Base class of the exceptions that this package defines."""


class SettingsError(MagTrackingError):
    """A setting has an unknown name, a wrong type, or a value out of range."""


class NetworkError(MagTrackingError):
    """The network file does not describe a usable network."""


class RecordingError(MagTrackingError):
    """A recording cannot be read, or lacks required data."""


class OutputError(MagTrackingError):
    """A result cannot be written to the requested location."""


class DeviceError(MagTrackingError):
    """A device (port, socket, broker or bus) cannot be opened or read."""


class ReadingsError(MagTrackingError, ValueError):
    """Readings have a wrong shape, type, order or range, or belong to no sensor of the network."""


class UnknownTrackError(MagTrackingError, LookupError):
    """A result has no track with the requested number."""


class MissingDependencyError(MagTrackingError, ImportError):
    """An optional package is not installed."""


class GraphError(MagTrackingError):
    """A topic, service or node of the ROS graph is missing, rejects a request, or times out."""


class ClusterError(MagTrackingError):
    """A Dask scheduler does not respond, has no worker, or has disconnected."""


class LabelsError(MagTrackingError):
    """Labelled examples are missing, overlap, or are too few for training."""
