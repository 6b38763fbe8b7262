"""Its old place, until every test imports it from ``drivers.testing``."""

from drivers.testing.stage import StageContract as StageContract
