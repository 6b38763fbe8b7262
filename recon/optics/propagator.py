"""What every way of computing a caustic offers to the rest of the optics."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal

import numpy as np
import numpy.typing as npt

from recon.optics.diffuser import Diffuser
from recon.optics.grid import PixelGrid
from recon.optics.spectrum import Spectrum

Emission = Literal["lambertian", "isotropic"]
Source = tuple[float, float, float]


class Propagator(ABC):
    """Point spread functions of one diffuser at one distance from the sensor.

    Parameters
    ----------
    diffuser : Diffuser
    distance_um : float
        From the diffuser's relief to the sensor.
    """

    def __init__(self, diffuser: Diffuser, distance_um: float) -> None:
        if not 0 < distance_um < np.inf:
            raise ValueError(f"The sensor lies behind the diffuser: distance_um > 0, not {distance_um}.")
        self.diffuser = diffuser
        self.distance_um = distance_um
        slope = np.hypot(*diffuser.slopes())
        self._typical_slope = float(np.sqrt((slope**2).mean()))
        self._steepest = float(np.quantile(slope, 0.9995))

    @abstractmethod
    def psf(
        self,
        source_um: Source,
        grid: PixelGrid,
        spectrum: Spectrum,
        *,
        diameter_um: float = 0.0,
        emission: Emission = "lambertian",
    ) -> npt.NDArray[np.float32]:
        """Light of a point source (or small disc) on the pixels of a sensor grid.

        Parameters
        ----------
        source_um : tuple of float
            ``(x, y, z)`` with ``z > 0``, any continuous position.
        grid : PixelGrid
            The sensor's pixels.
        spectrum : Spectrum
            Wavelengths that the source sends out, each with a weight; intensities add up.
        diameter_um : float
            Diameter of a uniformly bright disc parallel to the sensor (0: a point).
        emission : {"lambertian", "isotropic"}
            A pinhole or screen that faces the sensor, or a fluorescent bead.

        Returns
        -------
        ndarray, float32, ``grid.shape``
            Solid angle in steradians that feeds each pixel (times the cosine of emission for a Lambertian
            source): multiplied by the source's intensity along the axis, the light on the pixel. The angular
            response of the pixels is not included (:mod:`recon.optics.fall_off`).
        """

    def displacement_um(self, z_um: float) -> float:
        """Return how far the relief typically displaces light on the sensor (root mean square, on axis)."""
        contrast = self.diffuser.glass.index - self.diffuser.ambient.index
        return self._typical_slope * contrast * self._reduced_distance_um(z_um)

    def half_extent_um(self, z_um: float) -> tuple[float, float]:
        """Half height and width on the sensor that hold all light of a source at a distance, off axis too."""
        # 35 degrees off the axis; beyond, the little light that strays farther is cut off.
        spread = self._spread_um((0.7 * z_um, 0.0, z_um), 650.0)
        scale = 1 + self.distance_um / z_um
        height, width = self.diffuser.aperture_um
        return (height / 2 + spread) * scale, (width / 2 + spread) * scale

    def _reduced_distance_um(self, z_um: float) -> float:
        """Return ``z d / (z + d)``: the sensor's distance once the source's own curvature is taken out."""
        return self.distance_um / (1 + self.distance_um / z_um)

    def _spread_um(self, source_um: Source, wavelength_nm: float) -> float:
        """Return how far light may leave its straight ray, in the diffuser's plane, at the worst angle."""
        x, y, z = source_um
        half_height, half_width = (side / 2 for side in self.diffuser.aperture_um)
        tangent = np.hypot(abs(x) + half_width, abs(y) + half_height) / z
        cos = 1 / np.sqrt(1 + tangent**2)
        glass, ambient = self.diffuser.glass.at(wavelength_nm), self.diffuser.ambient.at(wavelength_nm)
        contrast = np.sqrt(glass**2 - (1 - cos**2)) - np.sqrt(ambient**2 - (1 - cos**2))
        stretched = self._reduced_distance_um(z) / cos**3
        refracted = self._steepest * abs(contrast) * stretched
        diffracted = 2.5 * np.sqrt(wavelength_nm * 1e-3 * stretched)
        return float(refracted + diffracted)


def check_source(source_um: Source) -> None:
    """Raise ``ValueError`` unless the source lies at a finite place in front of the diffuser."""
    if not (np.isfinite(source_um).all() and source_um[2] > 0):
        raise ValueError(f"A source lies in front of the diffuser: finite, z_um > 0, not {source_um}.")
