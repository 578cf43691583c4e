"""Events: detect and describe the passes of targets at individual sensors."""
