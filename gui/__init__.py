"""The desktop program: windows that show and ask. What they do is done by the rooms below.

Needs the extra ``[gui]`` (PySide6 and pyqtgraph). Started by ``diffuserbench gui``.
"""

import contextlib

with contextlib.suppress(ImportError, AttributeError):  # without Qt, or with another PySide
    import shiboken6  # noqa: F401 # brings the next
    from shibokensupport import feature

    # Each import after Qt's has its module's source read again, for the name of PySide, and kept in memory:
    # a seventh of the processor time of a start. It tells whether spellings that nobody here uses may be
    # switched off in a module; in all of them they may. No public way is known: PySide 6.11
    # has neither an option nor a variable of the environment for it.
    feature._mod_uses_pyside = lambda _: True
