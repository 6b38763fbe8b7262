"""What the optics of a comparison have in common, and what sets them apart."""

import numpy as np

from recon.evaluation import optics_compared as oc
from recon.optics.grid import GREEN, PixelGrid
from recon.optics.wave import WavePropagator


def test_all_collect_the_same_light_and_the_objective_alone_is_sharp_at_one_depth_only():
    grid = PixelGrid(oc.SHAPE, oc.PITCH_UM)
    light, peak = {}, {}
    for name in ("objective", "random lenslets"):
        optics = WavePropagator(oc._diffuser(name, 0), oc.DISTANCE_UM)
        psfs = [optics.psf((0.0, 0.0, z), grid, GREEN.samples(1), emission="isotropic") for z in oc.DEPTHS_UM]
        light[name] = float(psfs[1].sum())
        peak[name] = [float(psf.max() / psf.sum()) for psf in psfs]
    np.testing.assert_allclose(light["objective"], light["random lenslets"], rtol=0.05)
    assert peak["objective"][1] > 0.2  # in focus: most of it in a few pixels
    assert max(peak["objective"][0], peak["objective"][2]) < 0.2 * peak["objective"][1]
    assert min(peak["random lenslets"]) > 0.2 * peak["random lenslets"][1]


def test_beads_lie_on_the_planes_that_are_reconstructed():
    beads = oc._onto_depths(oc.bead_volume(9, (60.0, 60.0), (oc.DEPTHS_UM[0], oc.DEPTHS_UM[2])))
    assert set(beads.beads[0].positions_um[:, 2]) <= set(oc.DEPTHS_UM)
    planes = np.stack([oc._truth(beads, k) for k in range(3)])
    assert (planes > 0).any(axis=(1, 2)).all()
    assert oc._in_right_plane(planes, planes) > 0.99
    assert oc._in_right_plane(planes[::-1], planes) < 0.7
