"""Analysis: what the optics of a calibration can do (Kuo 2020, secs. 3.2, 4.4, 5.3)."""

from recon.base.handed_on import handed_on

_HOMES, __getattr__ = handed_on(globals())
__all__ = sorted(_HOMES)


def __dir__() -> list[str]:
    return __all__
