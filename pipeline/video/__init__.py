"""Many frames: where they come from."""
