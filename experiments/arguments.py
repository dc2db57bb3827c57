"""The experiments' command lines."""

import argparse
import signal
import sys
from collections.abc import Callable
from typing import NoReturn


class Parser(argparse.ArgumentParser):
    """argparse with one-line errors."""

    def __init__(self, prog: str, description: str | None) -> None:
        shown = argparse.RawDescriptionHelpFormatter
        super().__init__(prog=prog, description=description, formatter_class=shown, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message}", file=sys.stderr)
        sys.exit(2)


def run_to_the_end(prog: str, main: Callable[[], int]) -> NoReturn:
    """Exit as `main` says; Ctrl-C or SIGTERM first ends the run at work, which would go on alone, and is one line."""

    def stop(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        print(f"{prog}: interrupted; the same command goes on", file=sys.stderr)
        sys.exit(1)
