"""The edges: recordings, network files, importers, the simulator."""
