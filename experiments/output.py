"""Markdown tables and atomic writes of the experiments' outputs; text files: `qrl.runs.files.replace_text`."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, ["---"] * len(head), *rows))


def atomic_write(target: Path, write: Callable[[Path], object]) -> None:
    """Call `write` with a temporary path beside `target`, then rename it to `target`."""
    temporary = target.with_name(f"{target.name}.tmp")
    write(temporary)
    temporary.replace(target)
