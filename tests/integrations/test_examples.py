"""The examples in the docstrings of the adapters; the packaged folder is not among those where pytest collects them."""

import doctest
import importlib
import pkgutil

import pytest

from ca_reg import integrations

NEED_OTHERS = {"_splatfacto_method", "torchmetrics"}  # the latter has its own test
MODULES = [module.name for module in pkgutil.iter_modules(integrations.__path__) if module.name not in NEED_OTHERS]


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name):
    module = importlib.import_module(f"ca_reg.integrations.{name}")
    assert doctest.testmod(module, optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE).failed == 0
