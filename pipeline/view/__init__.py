"""A page that shows frames: served on loopback, or with its frames in it."""
