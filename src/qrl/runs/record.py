"""config.json: the settings that define a run, and the versions that made it."""

import hashlib
import json
import math
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from qrl.config import Config, current_names
from qrl_envs.specfile import Count, CountOrZero

FORMAT: Literal[1] = 1
_PACKAGES = ("qrl", "jax", "jaxlib", "brax", "flax", "optax", "orbax-checkpoint", "numpy")


class _Record(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TaskRecord(_Record):
    """The task's name as the user gave it and, for environments of qrl_envs, the content of its task file."""

    name: str
    spec: dict[str, Any] | None  # null: another environment


def with_current_names(data: dict[str, Any], where: str) -> dict[str, Any]:
    """The content of a config.json, or a part of one, with hyperparameters under their current names."""
    learner = data.get("learner")
    return data | {"learner": current_names(learner, f"{where}: learner")} if isinstance(learner, dict) else data


class Init(_Record):
    """The trained policy that a run begins with."""

    run: str  # its run folder, or the name of a run that ships, as the user gave it
    sha256: str  # of its numbers


class ConfigFile(_Record):
    """The file of CONFIG=: a run's config.json, or any part of one. Versions and devices are information only."""

    format: Literal[1] = FORMAT
    task: str | TaskRecord | None = None
    learner: dict[str, Any] = {}
    init: Init | None = None
    seed: CountOrZero | None = None
    seeds: Count | None = None
    versions: dict[str, str] = {}
    devices: list[str] = []


class RunConfig(_Record):
    """config.json: sufficient to repeat the run."""

    format: Literal[1] = FORMAT
    task: TaskRecord
    learner: Config
    init: Init | None = Field(default=None, exclude_if=lambda x: x is None)  # null: random numbers
    seed: CountOrZero
    seeds: Count
    versions: dict[str, str]
    devices: list[str]

    def member(self, index: int) -> "RunConfig":
        """The config of one seed, with the devices of one seed: seeds are split across devices first."""
        each = len(self.devices) // math.gcd(self.seeds, len(self.devices))
        return self.model_copy(update={"seed": self.seed + index, "seeds": 1, "devices": self.devices[:each]})

    @property
    def sha256(self) -> str:
        """The fingerprint of the run: task, hyperparameters, seeds and what it began with, not versions or devices."""
        settings = self.model_dump(mode="json", include={"task", "learner", "init", "seed", "seeds"})
        return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()


def versions() -> dict[str, str]:
    return {name: metadata.version(name) for name in _PACKAGES} | {"commit": commit()}


def commit() -> str:
    """The commit of this code, with a "+" if tracked files have changed since; "unknown" outside a checkout."""
    root = Path(__file__).parents[3]
    if not (root / ".git").exists():
        return "unknown"
    command = ["git", "-C", str(root), "describe", "--always", "--exclude=*", "--abbrev=12", "--dirty=+"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def member_folders(out: Path, run: RunConfig) -> list[Path]:
    """The folder of each seed: `out` itself for one, `out`/seed-K for several."""
    return [out] if run.seeds == 1 else [out / f"seed-{run.seed + i}" for i in range(run.seeds)]
