"""Its old place, until every test imports it from ``drivers.testing``."""

from drivers.testing.led_array import LedArrayContract as LedArrayContract
