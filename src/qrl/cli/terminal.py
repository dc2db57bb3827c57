"""What every command needs of the terminal it runs in: where it writes, and when it is told to stop."""

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from rich.console import Console

console = Console(highlight=False, markup=False, soft_wrap=True)


@contextmanager
def stop_requested(saying: str = "stopping: saving first") -> Iterator[Callable[[], bool]]:
    """Whether Ctrl-C (or SIGTERM) came; a second Ctrl-C interrupts at once."""
    asked = False

    def ask(number: int, _: Any) -> None:
        nonlocal asked
        if asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked = True
        console.print(saying)

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def clock(seconds: float) -> str:
    """Minutes and seconds."""
    minutes, seconds = divmod(round(seconds), 60)
    return f"{minutes}:{seconds:02d}"


DONE, FAILED, WRONG_INPUT = 0, 1, 2


def complain(message: str) -> None:
    """Say what is wrong, in one line."""
    print(f"qrl: {' '.join(message.split())}", file=sys.stderr)
