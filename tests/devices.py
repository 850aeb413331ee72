"""The devices that the fixture ``device`` goes through."""

import pytest
from stand_ins.card import CARD

DEVICES = ["cpu", CARD, pytest.param("cuda", marks=pytest.mark.gpu)]
