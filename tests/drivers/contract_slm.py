"""Its old place, until every test imports it from ``drivers.testing``."""

from drivers.testing.slm import SlmContract as SlmContract
