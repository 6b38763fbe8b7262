"""Numbers only: optics, operators, priors, solvers, analysis. Knows no device, no file format, no window.

What it offers stands in ``__init__.pyi``, and is imported when it is first asked for.
"""

from recon.base.handed_on import handed_on

_HOMES, __getattr__ = handed_on(globals())
__all__ = sorted(_HOMES)


def __dir__() -> list[str]:
    return __all__
