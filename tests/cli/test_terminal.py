"""The terminal: an interrupt that Python itself would lose."""

import gc
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import pytest

from qrl.cli import terminal


@contextmanager
def called_by_gc(callback: Callable[..., object]) -> Iterator[None]:
    gc.callbacks.append(callback)
    try:
        yield
    finally:
        gc.callbacks.remove(callback)


@pytest.fixture(autouse=True)
def _interruptible() -> Iterator[None]:
    """What a shell starts in the background ignores Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def collect_and_wait() -> None:
    gc.collect()
    time.sleep(10.0)


@pytest.mark.parametrize("losses", [1, 3])
def test_interrupt_within_a_callback_of_gc_is_not_lost(monkeypatch: pytest.MonkeyPatch, losses: int) -> None:
    lost = []

    def interrupted(phase: str, _: dict[str, int]) -> None:
        if phase == "start" and len(lost) < losses:
            lost.append(phase)
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(sys, "unraisablehook", lambda _: pytest.fail("told as ignored"))
    terminal.keep_interrupts()
    with called_by_gc(interrupted):
        for _ in range(losses):
            with pytest.raises(KeyboardInterrupt):
                collect_and_wait()
    assert len(lost) == losses


def test_other_errors_there_go_to_the_hook_of_before(monkeypatch: pytest.MonkeyPatch) -> None:
    told = []
    monkeypatch.setattr(sys, "unraisablehook", told.append)
    terminal.keep_interrupts()
    with called_by_gc(lambda *_: 1 / 0):
        gc.collect()
    assert told
    assert all(isinstance(each.exc_value, ZeroDivisionError) for each in told)


def test_ctrl_c_asks_to_stop_though_the_reader_is_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """In `| tee log` it ends tee first: what is printed goes nowhere, and the command goes on to save."""
    reader, writer = os.pipe()
    os.close(reader)
    monkeypatch.setattr(terminal.console, "quiet", False)
    with os.fdopen(writer, "w") as gone, terminal.stop_requested() as stopped:
        monkeypatch.setattr(sys, "stdout", gone)
        signal.raise_signal(signal.SIGINT)
        assert stopped()
        terminal.console.print("saved")


def test_ctrl_c_within_a_print_asks_to_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python refuses the handler a stream that it has interrupted."""

    def refused(*_: object) -> None:
        raise RuntimeError("reentrant call")

    monkeypatch.setattr(terminal.console, "print", refused)
    with terminal.stop_requested() as stopped:
        signal.raise_signal(signal.SIGINT)
        assert stopped()
