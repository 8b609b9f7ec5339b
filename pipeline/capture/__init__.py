"""Capture with a rig: bursts are recorded with a log that says which pulse every frame belongs to."""
