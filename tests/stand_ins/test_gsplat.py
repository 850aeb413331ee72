"""The stand-in for gsplat has the signature of the package; what it renders, compat/test_rasterization.py tests."""

import inspect

import pytest
from stand_ins.gsplat import rasterization, rasterization_1_4


def test_it_has_the_signature_of_the_package():
    gsplat = pytest.importorskip("gsplat", exc_type=ImportError)
    theirs = inspect.signature(gsplat.rasterization).parameters
    for stand_in in (rasterization, rasterization_1_4):
        ours = inspect.signature(stand_in).parameters
        assert list(theirs)[: len(ours)] == list(ours)
        assert {x: p.default for x, p in ours.items() if x != "tile_size"} == {  # 16, or None for 16, by version
            x: theirs[x].default for x in ours if x != "tile_size"
        }
