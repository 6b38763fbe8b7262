"""diffuserbench for notebooks and scripts: ``import diffuserbench as db``.

    psf, photo = db.read("psf.tif"), db.read("photo.tif")
    scene = db.reconstruct(photo, psf)
    scene.show()
    scene.save("scene.tif")

It defines nothing: what there is stands in ``__init__.pyi``, name by name with its home, and is imported when
it is first asked for.
"""

from recon.base.handed_on import handed_on

_HOMES, __getattr__ = handed_on(globals())
__all__ = sorted(_HOMES)


def __dir__() -> list[str]:
    return __all__
