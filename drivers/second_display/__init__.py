"""A spatial light modulator that is connected as a second display.

``slm`` is the driver. ``window`` draws with Qt, either in this process (``in_process``, where a Qt program
runs) or in a process of its own (``process`` here, ``child`` there). ``outputs`` and ``options`` need no Qt;
``x11`` asks the X server what Qt does not tell.
"""
