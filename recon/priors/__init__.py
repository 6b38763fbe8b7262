"""Priors: what is known about an object before the measurement, as value and proximal map."""

from recon.base.handed_on import handed_on

_HOMES, __getattr__ = handed_on(globals())
__all__ = sorted(_HOMES)


def __dir__() -> list[str]:
    return __all__
