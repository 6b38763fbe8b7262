"""Plans: what an acquisition will do, as data that counts, checks and iterates itself into steps."""

from recon.base.handed_on import handed_on

_HOMES, __getattr__ = handed_on(globals())
__all__ = sorted(_HOMES)


def __dir__() -> list[str]:
    return __all__
