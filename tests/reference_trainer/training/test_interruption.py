import signal
import threading

import pytest

from reference_trainer.training.config import TrainConfig
from reference_trainer.training.interruption import TrainingInterrupted, hold_interrupts
from reference_trainer.training.trainer import Trainer

both = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])


@both
def test_a_signal_waits_until_it_is_asked_for(number):
    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    with hold_interrupts() as stop:
        stop()
        signal.raise_signal(number)
        with pytest.raises(TrainingInterrupted, match=number.name) as caught:
            stop()
    assert caught.value.signal == number
    assert {n: signal.getsignal(n) for n in before} == before


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
def test_a_second_ctrl_c_does_not_wait(first):
    with hold_interrupts():
        signal.raise_signal(first)
        with pytest.raises(KeyboardInterrupt) as caught:
            signal.raise_signal(signal.SIGINT)
    assert not isinstance(caught.value, TrainingInterrupted)


def test_a_second_sigterm_waits_like_the_first():
    with hold_interrupts() as stop:
        for _ in range(3):
            signal.raise_signal(signal.SIGTERM)
        with pytest.raises(TrainingInterrupted):
            stop()


def test_what_the_process_ignores_stays_ignored():
    """As a shell tells its jobs in the background to do with Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with hold_interrupts() as stop:
            signal.raise_signal(signal.SIGINT)
            stop()
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_handler_that_is_not_of_python_is_left_alone(monkeypatch):
    before = signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    with hold_interrupts():
        pass
    monkeypatch.undo()
    assert signal.getsignal(signal.SIGINT) is before


@both
def test_the_last_step_is_no_shelter(tiny_scene, number):
    """What arrives while the last step is taken still interrupts, after it."""
    trainer = Trainer(tiny_scene, TrainConfig(iterations=2))

    def after_step(trainer: Trainer) -> None:
        if trainer.step == 2:
            signal.raise_signal(number)

    with pytest.raises(TrainingInterrupted):
        trainer.train(after_step=after_step)
    assert trainer.step == 2


def test_another_thread_trains_without_handlers(tiny_scene):
    trainer, before = Trainer(tiny_scene, TrainConfig(iterations=1)), signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=trainer.train)
    thread.start()
    thread.join()
    assert trainer.step == 1
    assert signal.getsignal(signal.SIGTERM) is before
