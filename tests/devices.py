"""The devices that the fixture ``device`` goes through."""

import pytest
from stand_ins.card import CARD

DEVICES = ["cpu", CARD, pytest.param("cuda", marks=pytest.mark.gpu)]
slow_on_card = pytest.mark.parametrize(
    "device", [DEVICES[0], pytest.param(CARD, marks=pytest.mark.slow), DEVICES[2]], indirect=True
)
