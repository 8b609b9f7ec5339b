"""Where pulses come from: one file an instrument, each with the methods of `hardware.protocols.Trigger`."""
