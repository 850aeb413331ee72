"""Expressions as text: what they make, and what they refuse."""

import sys

import pytest
import torch

from ca_reg import GaussianDropout, OpacityNoise, Regularizer
from ca_reg.registry import Registry
from ca_reg.regularizers import REGULARIZERS, parse
from ca_reg.schedules import LinearRamp


def test_names_arguments_schedules_and_sums():
    chain = list(parse("dropout(ramp(0.0, 0.2, 0, 10_000), compensate=True) + noise(sigma=0.8)"))
    assert repr(chain[0]) == repr(GaussianDropout(LinearRamp(0.0, 0.2, 0, 10_000), compensate=True))
    assert repr(chain[1]) == repr(OpacityNoise(0.8))
    assert len(parse("  ")) == 0


def test_a_dictionary_is_a_literal_too():
    (made,) = Registry("dictionary", dict, of=dict).make("of({1:True, 'a:b':None})")
    assert made == {1: True, "a:b": None}


def test_a_class_in_a_file_of_the_working_directory(tmp_path, monkeypatch):
    (tmp_path / "mine_for_this_test.py").write_text(
        "from ca_reg import IndependentDropout\n"
        "class Half(IndependentDropout):\n"
        "    def __init__(self, rate=0.5):\n"
        "        super().__init__()\n"
        "        self.rate = rate\n"
        "    def rates(self, x):\n"
        "        return self.rate\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p != ""])
    monkeypatch.delitem(sys.modules, "mine_for_this_test", raising=False)
    half, other = parse("mine_for_this_test:Half + mine_for_this_test:Half(0.25)")
    assert isinstance(half, Regularizer)
    assert torch.equal(other.eval()(torch.ones(2)), torch.full((2,), 0.75))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("dropot(0.2)", "no regularizer 'dropot'; .*dropout"),
        ("dropout(", "as regularizers"),
        ("dropout(0.2) - noise(0.8)", "is no regularizer; write dropout"),
        ("dropout(1.5)", r"dropout\(1.5\)\': p must be in \[0, 1\)"),
        ("dropout(rate=0.2)", "unexpected keyword argument 'rate'"),
        ("dropout(__import__('os').getcwd())", r"getcwd\(\)\" is none of ramp, .*Python's literals"),
        ("dropout(**{'p': 0.2})", "keywords must be strings"),
        ("os:getcwd()", "os:getcwd .*no subclass"),
        ("torch.nn:Dropout(0.2)", "no subclass of Regularizer"),
        ("no_such_module:Thing", "cannot be had: No module named 'no_such_module'"),
        ("ca_reg:NoSuchClass", "cannot be had"),
        ("+".join(["dropout(0.1)"] * 9) + "+(", "cannot be read"),
        ("(lambda: 0)()", "is no regularizer"),
        ("dropout(1" + "0" * 309 + ")", "p .*finite, got 1000"),
        ("segs(stop=None)", "stop .*integer"),
        ("noise(sigma=0.8, sigma=0.1)", "sigma is given twice"),
        ("dropout(ramp(0, 0.2, 0, end_step=5, end_step=9))", "end_step is given twice"),
        # Deeper than Python's limit for recursion:
        ("noise(" + "-" * 500 + "1)", "-- is none of ramp"),
        ("noise(" + "*".join("1" * 400) + ")", r"1\*1.* is none of ramp"),
        ("noise" + "(1)" * 600, "is no regularizer"),
        ("noise" + ".a" * 600, "cannot be had"),
    ],
)
def test_what_cannot_be_made_is_refused_by_name(text, message):
    with pytest.raises(ValueError, match=message):
        parse(text)


def test_text_among_the_arguments_is_left_as_it_is():
    registry = Registry("word", str, word=str)
    assert registry.make("word('a:b') + word('x + y:z')") == ["a:b", "x + y:z"]


def test_a_name_is_entered_once():
    registry = Registry("animal", object)
    registry.register("cat")(dict)
    registry.register("cat")(dict)
    with pytest.raises(ValueError, match="animal 'cat' already"):
        registry.register("cat")(list)


def test_every_name_makes_a_regularizer():
    assert {"dropout", "noise"} <= set(REGULARIZERS)
