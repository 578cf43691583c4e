"""Drivers: what devices say, as samples. One file a transport, a framing or a kind of chip."""
