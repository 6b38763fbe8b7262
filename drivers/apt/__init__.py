"""Thorlabs motion controllers over the APT protocol: DC servos, steppers, piezo inertia drives."""
