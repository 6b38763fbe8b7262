"""Its old place, until every test imports it from ``drivers.testing``."""

from drivers.testing.device import DeviceContract as DeviceContract
