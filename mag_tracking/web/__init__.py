"""Live page: tracks sent to browsers over a WebSocket."""
