"""Track: from frames to tracks."""
