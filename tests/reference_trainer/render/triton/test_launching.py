"""What is compiled once is started directly, with the constants in the kernel's order; everything else by Triton."""

import pytest
import torch

pytest.importorskip("triton")

from triton import language as tl

from reference_trainer.render.triton.launching import LAUNCHED, kernel, launch


@pytest.fixture
def calls():
    """Every start: by whom, the grid, the arguments in order, and the options and constants by name."""
    return []


class StandIn:
    """A kernel of two arguments and two constants, or, by ``who``, its machine code."""

    arg_names = ("x", "count", "FIRST", "SECOND")

    def __init__(self, calls, answer=None, who="triton"):
        self.calls, self.answer, self.who = calls, answer, who

    def fn(self):
        """What Triton would compile."""

    def __getitem__(self, grid):
        def start(*arguments, **named):
            self.calls.append((self.who, grid, arguments, named))
            return self.answer

        return start


def stand_in(calls):
    return StandIn(calls, StandIn(calls, who="machine code"))


def test_the_second_start_is_direct(calls):
    x, known = torch.zeros(3), LAUNCHED["fn"]
    fake = stand_in(calls)
    for count in (3, 1):
        launch(fake, (7, 2), x, count, warps=4, SECOND=2, maxnreg=64, FIRST=1)
    options = {"num_warps": 4, "enable_fp_fusion": True, "SECOND": 2, "maxnreg": 64, "FIRST": 1}
    assert calls == [("triton", (7, 2), (x, 3), options), ("machine code", (7, 2, 1), (x, 1, 1, 2), {})]
    assert LAUNCHED["fn"] == known + 2


@pytest.mark.parametrize(
    ("x", "changed"),
    [(torch.zeros(3, dtype=torch.int16), {}), (torch.zeros(3), {"FIRST": 5}), (torch.zeros(3), {"warps": 8})],
)
def test_other_types_constants_or_warps_are_other_machine_code(calls, x, changed):
    fake = stand_in(calls)
    launch(fake, (1,), torch.zeros(3), 3, FIRST=1, SECOND=2)
    launch(fake, (1,), x, 3, **{"FIRST": 1, "SECOND": 2} | changed)
    assert [who for who, *_ in calls] == ["triton", "triton"]


def test_what_is_interpreted_is_started_by_triton_every_time(calls):
    fake = StandIn(calls)
    for _ in range(2):
        launch(fake, (1,), torch.zeros(3), 3, FIRST=1, SECOND=2)
    assert [who for who, *_ in calls] == ["triton", "triton"]


def test_an_empty_grid_is_no_launch(calls):
    launch(stand_in(calls), (4, 0), torch.zeros(3), 3, FIRST=1, SECOND=2)
    assert calls == []


def test_nothing_of_an_argument_is_compiled_in():
    """Neither an address that 16 divides nor a number that is 1: the machine code is started with any."""

    @kernel
    def double(x, count, SIZE: tl.constexpr):
        pass

    assert list(double.do_not_specialize) == ["x", "count"]
    assert [each.do_not_specialize for each in double.params] == [True, True, False]
