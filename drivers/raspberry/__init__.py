"""Cameras on the CSI connector of a Raspberry Pi, through picamera2."""
