"""The assembled bench: configuration, devices, lights, safety."""
