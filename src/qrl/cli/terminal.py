"""The terminal: exit codes, output, progress, and the request to stop."""

import _thread
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

from rich.console import Console

DONE, FAILED, WRONG_INPUT = 0, 1, 2
STARTED = time.time() - 5.0  # s since the epoch: no module was read before


class _Console(Console):
    """rich's, which would exit the command where whoever reads its output is gone, as `tee` is after a Ctrl-C."""

    def on_broken_pipe(self) -> None:
        with suppress(SystemExit):
            super().on_broken_pipe()  # quiet from now on


console = _Console(highlight=False, markup=False, soft_wrap=True)


def print_error(message: str) -> None:
    print(f"qrl: {' '.join(message.split())}", file=sys.stderr)


@contextmanager
def progress_bar(total: float, completed: float = 0.0) -> Iterator[Callable[[float, str], None]]:
    """A bar on a terminal, and nothing elsewhere; yields a function that sets how much is completed, and a note."""
    from rich.progress import BarColumn, Progress, TextColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[note]}"))
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=total, completed=int(completed), note="")
        yield lambda completed, note: bar.update(task, completed=completed, note=note)


@contextmanager
def stop_requested(message: str = "stopping: saving first") -> Iterator[Callable[[], bool]]:
    """Yields whether Ctrl-C or SIGTERM came; a second Ctrl-C interrupts at once."""
    requested = False

    def handle(number: int, _: Any) -> None:
        nonlocal requested
        if requested and number == signal.SIGINT:
            raise KeyboardInterrupt
        requested = True
        with suppress(Exception):  # the terminal may be gone, or be written to just now
            console.print(message)

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: requested
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def keep_interrupts() -> None:
    """Raise a KeyboardInterrupt again that Python ignores, since it fell into a finalizer or a callback of gc.

    JAX registers such a callback: without this, a Ctrl-C in a garbage collection is lost.
    """
    others = sys.unraisablehook
    main = threading.main_thread().ident or 0

    def interrupt() -> None:
        time.sleep(0.01)  # raised at once, it would be ignored once more
        signal.pthread_kill(main, signal.SIGINT)

    def hook(unraisable: "sys.UnraisableHookArgs") -> None:
        if isinstance(unraisable.exc_value, KeyboardInterrupt):
            _thread.start_new_thread(interrupt, ())  # takes no lock that the collection may have come in
        else:
            others(unraisable)

    sys.unraisablehook = hook


def plural(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'s' * (count != 1)}"


def clock(seconds: float) -> str:
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02d}"
