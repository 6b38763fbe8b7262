"""Stages whose controller runs GRBL 1.1 or grblHAL, over a serial port."""
