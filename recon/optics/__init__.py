"""The optics of a camera behind a diffuser: height maps, propagation, sources, scenes, sensors.

Forward physics only, in continuous coordinates; nothing here knows how a picture is reconstructed, and no
reconstruction uses it. Coordinates as in :mod:`recon.types`: origin at the centre of the diffuser's
aperture, ``x`` along the sensor's columns, ``y`` along its rows, ``z`` from the diffuser towards the scene;
the sensor lies in the plane ``z = -d``, its geometric centre (between two pixels where a side is even)
opposite the origin.
"""
