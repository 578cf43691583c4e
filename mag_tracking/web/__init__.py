"""Live page: tracks sent to browsers over a WebSocket."""

LOOPBACK, DEFAULT_PORT = '127.0.0.1', 8765
