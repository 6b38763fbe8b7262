"""Solvers: an operator, data and a prior in; an object, a history and the reason to stop out."""

from recon.base.handed_on import handed_on

_HOMES, __getattr__ = handed_on(globals())
__all__ = sorted(_HOMES)


def __dir__() -> list[str]:
    return __all__
