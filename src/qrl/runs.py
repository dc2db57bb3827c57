"""The run folder's files: what was asked (config.json) and what happened (metrics.csv)."""

import csv
import hashlib
import io
import json
import math
import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import metadata, resources
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from qrl.config import Config, Count, CountOrZero

FORMAT: Literal[1] = 1
_PACKAGES = ("qrl", "jax", "jaxlib", "brax", "flax", "optax", "orbax-checkpoint", "numpy")


class TaskRecord(BaseModel):
    """The task's name as the user gave it and, for our own worlds, everything that the task file said."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    spec: dict[str, Any] | None  # null: one of Brax's own environments


class ConfigFile(BaseModel):
    """What CONFIG= may hold: a run's config.json, or any part of one. Versions are for the reader."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = FORMAT
    task: str | TaskRecord | None = None
    learner: dict[str, Any] = {}
    seed: CountOrZero | None = None
    seeds: Count | None = None
    versions: dict[str, str] = {}
    devices: list[str] = []


class RunConfig(BaseModel):
    """config.json: alone enough to repeat the run."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    format: Literal[1] = FORMAT
    task: TaskRecord
    learner: Config
    seed: CountOrZero
    seeds: Count
    versions: dict[str, str]
    devices: list[str]

    def member(self, index: int) -> "RunConfig":
        """The config of one of the seeds trained side by side, with as many devices as a seed had: seeds part first."""
        each = len(self.devices) // math.gcd(self.seeds, len(self.devices))
        return self.model_copy(update={"seed": self.seed + index, "seeds": 1, "devices": self.devices[:each]})

    @property
    def sha256(self) -> str:
        """What tells this run from every other, whatever it is run on."""
        asked = self.model_dump(mode="json", include={"task", "learner", "seed", "seeds"})
        return hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()


def versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in _PACKAGES} | {"commit": commit()}


def commit() -> str:
    """The commit of the code that runs, "+" behind it where files have changed since; "unknown" outside a checkout."""
    root = Path(__file__).parents[2]
    try:
        if not (root / ".git").exists():
            return "unknown"
        git = ["git", "-C", str(root)]
        head = subprocess.run([*git, "rev-parse", "--short=12", "HEAD"], capture_output=True, text=True, check=True)
        changed = subprocess.run(
            [*git, "status", "--porcelain", "--untracked-files=no"], capture_output=True, check=True
        )
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head.stdout.strip() + ("+" if changed.stdout.strip() else "")


def preset(name: str) -> dict[str, Any]:
    """The learner's defaults laid under the preset `name` ("default" for a task without one of its own)."""
    folder = resources.files("qrl").joinpath("presets")
    data = json.loads(folder.joinpath("default.json").read_text(encoding="utf-8"))
    if name != "default":
        data |= json.loads(folder.joinpath(f"{name}.json").read_text(encoding="utf-8"))
    return data


def presets() -> list[str]:
    folder = resources.files("qrl").joinpath("presets")
    return sorted(entry.name.removesuffix(".json") for entry in folder.iterdir() if entry.name.endswith(".json"))


def members(out: Path, run: RunConfig) -> list[Path]:
    """The folder of each seed: `out` itself, or out/seed-K for several."""
    return [out] if run.seeds == 1 else [out / f"seed-{run.seed + i}" for i in range(run.seeds)]


def write_json(path: Path, data: Any) -> None:
    """Write `data` whole or not at all."""
    replace_text(path, json.dumps(_plain(data), indent=2) + "\n")


def replace_text(path: Path, text: str) -> None:
    """Write a file under another name and rename it: whoever reads sees the old one or the new one, whole."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")  # nobody else's, should two write the same file
    with writing(path):
        try:
            with temporary.open("w", encoding="utf-8") as file:
                file.write(text)
                file.flush()
                os.fsync(file.fileno())  # a name that outlives a crash must not point at what did not
            temporary.replace(path)
        except OSError:
            temporary.unlink(missing_ok=True)
            raise


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """While `path` is written: an OSError's message names it, whatever the system calls it."""
    try:
        yield
    except OSError as error:
        raise OSError(f"{path}: cannot be written ({error.strerror or error})") from None


def tidy(folder: Path) -> None:
    """Remove what a killed process left of files that it was writing; for who alone writes in this run folder."""
    for name in ("config.json", "metrics.csv", "summary.json", "evaluation.json"):
        for temporary in folder.glob(f"{name}.*.tmp"):
            temporary.unlink(missing_ok=True)


def _plain(data: Any) -> Any:
    """JSON has no infinities: a number that is not finite becomes null."""
    if isinstance(data, dict):
        return {key: _plain(value) for key, value in data.items()}
    if isinstance(data, list | tuple):
        return [_plain(value) for value in data]
    return None if isinstance(data, float) and not math.isfinite(data) else data


Row = dict[str, float | int]
REPORTED = ("env_steps", "updates", "return_mean", "return_min", "success", "train_seconds")  # by every run


def read_metrics(folder: Path) -> list[Row]:
    """The rows of metrics.csv; an empty cell (not measured) is NaN. OSError, naming the file, if it is damaged."""
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


def comparable(value: float) -> float:
    """For rankings: what was not measured, or is no number, is the worst."""
    return -math.inf if math.isnan(value) else value


def write_metrics(folder: Path, rows: list[Row]) -> None:
    """Write metrics.csv anew: a few dozen rows, and so it is never half-written. Without a row there is none."""
    if not rows:
        (folder / "metrics.csv").unlink(missing_ok=True)
        return
    replace_text(folder / "metrics.csv", csv_text(rows))


def csv_text(rows: list[dict[str, Any]]) -> str:
    """Rows as CSV, the same columns in each; NaN (not measured) is an empty cell."""
    text = io.StringIO()
    names = dict.fromkeys(name for row in rows for name in row)
    writer = csv.DictWriter(text, fieldnames=list(names), lineterminator="\n")
    writer.writeheader()
    writer.writerows(
        {key: "" if isinstance(value, float) and math.isnan(value) else value for key, value in row.items()}
        for row in rows
    )
    return text.getvalue()
