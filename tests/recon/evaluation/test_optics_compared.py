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


def test_an_objective_is_as_sharp_off_its_axis():
    grid = PixelGrid(oc.SHAPE, oc.PITCH_UM)
    optics = oc._Corrected(oc._diffuser("objective", 0), oc.DISTANCE_UM)
    z, pixels = oc.DEPTHS_UM[1], 15
    x = pixels * oc.PITCH_UM * z / oc.DISTANCE_UM
    axis, off = (optics.psf((at, 0.0, z), grid, GREEN.samples(1), emission="isotropic") for at in (0.0, x))
    middle = oc.SHAPE[1] // 2
    assert off.argmax() == axis.argmax() - pixels == middle * oc.SHAPE[1] + middle - pixels
    np.testing.assert_allclose(off.max(), axis.max(), rtol=0.05)
    assert axis.max() > 0.7 * axis.sum()  # one pixel: the axis meets its middle


def test_beads_lie_on_the_planes_that_are_reconstructed():
    beads = oc._onto_depths(oc.bead_volume(9, (60.0, 60.0), (oc.DEPTHS_UM[0], oc.DEPTHS_UM[2])))
    assert set(beads.beads[0].positions_um[:, 2]) <= set(oc.DEPTHS_UM)
    planes = np.stack([oc._truth(beads, k) for k in range(3)])
    assert (planes > 0).any(axis=(1, 2)).all()
    assert oc._light_in_place(planes, planes) > 0.99
    assert oc._light_in_place(planes[::-1], planes) < 0.7
    assert oc._light_in_place(planes + planes.max() / 10, planes) < 0.1  # haze is in nobody's place
