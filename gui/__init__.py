"""The desktop program: windows that show and ask. What they do is done by the rooms below.

Needs the extra ``[gui]`` (PySide6 and pyqtgraph). Started by ``diffuserbench gui``.
"""
