"""The rig: what is wired to this machine."""
