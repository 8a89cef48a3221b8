"""Small random machines: a plate with random candidates, die, disturbances."""

import pytest

import flexplant.parallel
from placement_plate import machine


@pytest.fixture(scope="session")
def make():
    return machine


@pytest.fixture
def send_everything(monkeypatch):
    """All items but the first leave for the executor, in small chunks."""
    monkeypatch.setattr(flexplant.parallel, "PROBE", 0.0)
    monkeypatch.setattr(flexplant.parallel, "CHUNK", 0.01)
