"""One way from a measurement to a picture."""
