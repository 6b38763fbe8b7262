"""Operators and solvers by array namespace: the same lines run on NumPy and, on a GPU, on CuPy.

One family serves pictures (one depth) and volumes. They do what the compiled solvers of :mod:`recon.volume`
do, iteration by iteration, with whole arrays instead of sweeps over planes: more memory, no compiled
code, and a GPU does not mind. On NumPy they are the plain reference to which the compiled ones are held.
"""

from recon.gpu.camera import DepthCamera
from recon.gpu.douglas_rachford import PlainDouglasRachford
from recon.gpu.namespace import array_namespace, to_host
from recon.gpu.total_variation import PlainTotalVariation

__all__ = ["DepthCamera", "PlainDouglasRachford", "PlainTotalVariation", "array_namespace", "to_host"]
