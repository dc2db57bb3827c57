"""How the command line ends: DESIGN.md's exit codes, and one line on stderr."""

import sys

DONE, FAILED, WRONG_INPUT = 0, 1, 2


def complain(message: str) -> None:
    """Say what is wrong, in one line."""
    print(f"qrl: {' '.join(message.split())}", file=sys.stderr)
