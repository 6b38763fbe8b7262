"""Holograms through a scattering mask (Kuo 2020, Ch. 7 and A.4): model, losses, optimisers, étendue.

In short::

    display = Display((540, 960), random_mask((2160, 3840)))
    model = HologramModel(display, [Target(image)], HologramOptions(loss="frequency"))
    hologram = compute_hologram(model)
    print(judge(hologram.slm, display, Target(image)).psnr_db)
"""

from recon.base.handed_on import handed_on

_HOMES, __getattr__ = handed_on(globals())
__all__ = sorted(_HOMES)


def __dir__() -> list[str]:
    return __all__
