"""Drivers are found by name, and an unknown one is refused with what is available."""

import pytest

from drivers.errors import DeviceError
from drivers.registry import KINDS, driver_names, load_driver


@pytest.mark.parametrize("kind", KINDS)
def test_the_simulated_driver_of_each_kind_is_registered(kind: str) -> None:
    assert "simulated" in driver_names(kind)


def test_an_unknown_driver_is_refused_with_the_names_that_exist() -> None:
    with pytest.raises(DeviceError, match=r"stage \(flying_carpet\).*Available:.*simulated"):
        load_driver("stage", "flying_carpet")
