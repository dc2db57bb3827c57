"""The experiments' command lines."""

import argparse
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NoReturn


class Parser(argparse.ArgumentParser):
    """argparse with one-line errors."""

    def __init__(self, prog: str, description: str | None) -> None:
        shown = argparse.RawDescriptionHelpFormatter
        super().__init__(prog=prog, description=description, formatter_class=shown, allow_abbrev=False)

    def error(self, message: str) -> NoReturn:
        print(f"{self.prog}: {message}", file=sys.stderr)
        sys.exit(2)

    def check_folder(self, flag: str, path: Path) -> None:
        """Exit with an error if the folder that `flag` names is a file."""
        if path.exists() and not path.is_dir():
            self.error(f"{flag}: {path} is a file; expected a folder, or a name for a new one")


def run_main(prog: str, main: Callable[[], int]) -> NoReturn:
    """Exit with the code of `main`. Ctrl-C and SIGTERM first end the child process and print one line."""

    def stop(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, stop)
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        print(f"{prog}: interrupted; the same command resumes", file=sys.stderr)
        sys.exit(1)
