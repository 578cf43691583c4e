"""The live page: what is tracked now, sent to browsers over a WebSocket."""
