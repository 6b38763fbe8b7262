"""One interface a kind of device, its real drivers, and the simulated bench.

``camera``, ``stage``, ``led_array`` and ``slm`` hold the interfaces; ``drivers.simulated`` the embedded
default; ``registry`` finds drivers by name, built in or from other packages.
"""
