"""The demos: the whole job on a simulated bench, of the camera, of the display, and of a film."""
