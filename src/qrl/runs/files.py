"""Files of a run folder: atomic writes, CSV and the lock."""

import csv
import fcntl
import io
import json
import math
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from qrl_envs.specfile import BadInput


def write_json(path: Path, data: Any) -> None:
    """Write `data` atomically; numbers that are not finite become null."""
    replace_text(path, json.dumps(_plain(data), indent=2) + "\n")


def replace_text(path: Path, text: str) -> None:
    """Write a file atomically: to a temporary name, then renamed. OSError names `path`."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())  # before the name: after a crash it must not point to missing data


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """The temporary name of what, once it is whole, is called `path`. OSError names `path`."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")  # one for each process
    with writing(path):
        try:
            yield temporary
            temporary.replace(path)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Name `path` in the message of an OSError that is raised while it is written."""
    try:
        yield
    except OSError as error:
        raise OSError(f"{path}: cannot be written ({error.strerror or error})") from None


def check_output(path: Path, flag: str) -> None:
    """BadInput, which names the flag, unless a file can be written at `path`: before the work that it is for."""
    if path.is_dir():
        raise BadInput(f"{flag}: expected the name of a file, found the folder {path}")
    if not (path.parent.is_dir() and os.access(path.parent, os.W_OK)):
        raise BadInput(f"{flag}: expected a file in a folder that is there and can be written to, found {path}")


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files of a process that was killed. The caller must hold the lock of the run folder."""
    for name in ("config.json", "metrics.csv", "summary.json", "evaluation.json"):
        for temporary in folder.glob(f"{name}.*.tmp"):
            temporary.unlink(missing_ok=True)


def _plain(data: Any) -> Any:
    if isinstance(data, dict):
        return {key: _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


Row = dict[str, float | int]  # of metrics.csv

REPORTED = ("env_steps", "updates", "return_mean", "return_min", "success", "train_seconds")  # columns of every run


def read_metrics(folder: Path) -> list[Row]:
    """The rows of metrics.csv; an empty cell (not measured) is NaN. OSError, naming the file, if it is corrupt."""
    path = folder / "metrics.csv"
    if not path.exists():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            header, *lines = csv.reader(file)
        rows = [dict(zip(header, map(_number, line), strict=True)) for line in lines]
        if not set(REPORTED) <= set(header) or not all(
            math.isfinite(row["env_steps"] + row["train_seconds"]) for row in rows
        ):
            raise ValueError("expected the columns of a run's reports")
    except (ValueError, csv.Error) as error:
        raise OSError(f"{path}: cannot be read ({str(error)[:120]})") from None
    return rows


def _number(cell: str) -> float | int:
    number = float(cell or "nan")
    return int(number) if abs(number) < 2**53 and cell.lstrip("-").isdigit() else number


def rank_key(value: float) -> float:
    """`value` as a sort key; NaN (not measured) ranks last."""
    return -math.inf if math.isnan(value) else value


def write_metrics(folder: Path, rows: list[Row]) -> None:
    """Replace metrics.csv atomically; without rows, remove it."""
    if not rows:
        (folder / "metrics.csv").unlink(missing_ok=True)
        return
    replace_text(folder / "metrics.csv", csv_text(rows))


def csv_text(rows: list[dict[str, Any]]) -> str:
    """Rows as CSV, with the columns of all rows; NaN (not measured) is an empty cell."""
    text = io.StringIO()
    names = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(text, fieldnames=list(names), lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {key: "" if isinstance(value, float) and math.isnan(value) else value for key, value in row.items()}
        for row in rows
    )
    return text.getvalue()


@contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Hold the lock file at `path`, at most until the process ends; BadInput(busy) if another process holds it.

    On a file system without locks, print a warning and continue.
    """
    with path.open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BadInput(busy) from None
        except OSError as error:
            print(
                f"qrl: warning: {path}: the file system cannot lock ({error.strerror}):"
                " do not start a second process on this folder",
                file=sys.stderr,
            )
        yield
