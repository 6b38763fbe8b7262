"""Devices that another computer's ``diffuserbench serve`` offers, over HTTP and WebSocket."""
