"""The run folder's files: what was asked (config.json) and what happened (metrics.csv)."""

import hashlib
import json
import math
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict

from qrl.config import Config, current_names
from qrl_envs.specfile import Count, CountOrZero

FORMAT: Literal[1] = 1
_PACKAGES = ("qrl", "jax", "jaxlib", "brax", "flax", "optax", "orbax-checkpoint", "numpy")


class TaskRecord(BaseModel):
    """The task's name as the user gave it and, for our own worlds, everything that the task file said."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    spec: dict[str, Any] | None  # null: one of Brax's own environments


def with_current_names(data: dict[str, Any], where: str) -> dict[str, Any]:
    """The content of a config.json, whole or in part, with hyperparameters under today's names."""
    learner = data.get("learner")
    return data | {"learner": current_names(learner, f"{where}: learner")} if isinstance(learner, dict) else data


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


def members(out: Path, run: RunConfig) -> list[Path]:
    """The folder of each seed: `out` itself, or out/seed-K for several."""
    return [out] if run.seeds == 1 else [out / f"seed-{run.seed + i}" for i in range(run.seeds)]
