"""Devices that Micro-Manager's adapters serve: cameras, stages, lights, SLMs."""
