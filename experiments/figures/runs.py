"""The runs that the figures are drawn from: which there are, whether they are current, and how one is made."""

import ast
import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from qrl import request, tasks
from qrl.config import load_preset
from qrl.runs import files, learning_curve, record
from qrl.runs.learning_curve import Rows
from qrl.runs.record import ConfigFile, RunConfig

ROOT = Path(__file__).resolve().parents[2]
ROOMS = {"qrl": ROOT / "src" / "qrl", "qrl_envs": ROOT / "envs" / "qrl_envs"}
TRAINING = ("qrl.training.driver", "qrl_envs.env")  # what they import, and they, decide a run's numbers
CODE = "code.sha256"  # in a run's folder: of which code it is

SEEDS, FAST_SEEDS = 6, 2  # even, so that two cores share them
# Schulman et al. 2017: eight whole passes over the last unroll of 16 lanes, the ratio clipped at 0.2, GAE(0.95). What
# differs: no entropy bonus, and the step size and sigma of the method that it stands beside.
PPO = {
    "replay_unrolls": 1, "warmup_unrolls": 1, "sampling": "epochs", "symmetries": False, "advantage": "mu",
    "lam": 0.95, "epsilon": 0.2, "updates_per_unroll": 16, "batch_size": 8,
}
PAPER_RATES = {"high": 1e-4, "low": 0.5e-5}
METHOD = {"apg_fraction": 0.0}  # the paper's method to the end, on trajectories that symmetries turn
RATIO = PAPER_RATES["high"] / PAPER_RATES["low"]


class Failed(RuntimeError):
    """A run ended with an error; the message says which, in a line."""


class RunSpec(NamedTuple):
    """A run that a figure needs; its folder is named so."""

    name: str
    task: str
    preset: str  # whose values the flags are laid over
    flags: dict[str, Any]  # of `qrl train`, by the names of qrl.config
    seeds: int = 1
    seed: int = 0

    @property
    def words(self) -> list[str]:
        """The command, but for its --out."""
        preset = [] if self.preset == self.task else ["--preset", self.preset]
        flags = [
            w
            for name, value in self.flags.items()
            for w in (f"--{name.replace('_', '-')}", json.dumps(value).strip('"'))
        ]
        seed = ["--seed", str(self.seed)] * bool(self.seed)
        return ["train", self.task, *seed, "--seeds", str(self.seeds), *preset, *flags]

    def config(self) -> RunConfig:
        """What its config.json says if it is made now."""
        return request.run_config(self.task, None, ConfigFile(), self.flags, self.seed, self.seeds, preset=self.preset)


def plan(*, fast: bool) -> list[RunSpec]:
    """All runs, the quickest tasks first."""
    seeds = FAST_SEEDS if fast else SEEDS
    found = pendulums("pendulum_fast" if fast else "pendulum", seeds, paper=not fast)
    if fast:
        return [
            *found,
            RunSpec("hover", "hover", "hover_fast", METHOD, seeds),
            RunSpec("circle", "circle", "circle_fast", METHOD | {"num_timesteps": 1_200_000}, seeds),
        ]
    return [
        *found,
        RunSpec("hover", "hover", "hover", METHOD | {"num_timesteps": 1_500_000, "num_evals": 25}, seeds),
        RunSpec("circle", "circle", "circle_fast", METHOD | {"num_timesteps": 2_400_000, "num_evals": 20}, seeds),
        RunSpec("hover-flight", "hover", "hover", METHOD | {"num_timesteps": 4_500_000}),
        RunSpec("circle-flight", "circle", "circle", METHOD | {"num_timesteps": 4_500_000}),
    ]


def pendulums(preset: str, seeds: int, *, paper: bool) -> list[RunSpec]:
    """Both methods at two rates around the recipe's own; with `paper` at the paper's two rates too, held constant."""
    recipe = {name: load_preset(preset)[name] for name in ("learning_rate", "learning_rate_end")}
    rates = {"high": recipe, "low": {name: float(f"{value / RATIO:.6g}") for name, value in recipe.items()}}
    if paper:
        constant = {name: {"learning_rate": r, "learning_rate_end": r} for name, r in PAPER_RATES.items()}
        rates |= {f"paper-{name}": rate for name, rate in constant.items()}
    methods = {"": {}, "-ppo": PPO}
    return [
        RunSpec(f"pendulum-{rate}{method}", "pendulum", preset, flags | more, seeds)
        for rate, flags in rates.items()
        for method, more in methods.items()
    ]


# Whether a run is there


def is_current(folder: Path, run: RunConfig) -> bool:
    """Whether this very run is there, finished, made by the code and with the versions that are here now."""
    return (folder / "summary.json").exists() and is_same(folder, run)


def is_same(folder: Path, run: RunConfig) -> bool:
    """Whether `folder` holds this very run, finished or not. On which devices and at which commit is no matter."""
    try:
        stored = json.loads((folder / "config.json").read_text())
        code = (folder / CODE).read_text()
    except (OSError, ValueError):
        return False
    return isinstance(stored, dict) and deciding(stored) == deciding(run.model_dump(mode="json")) and code == sha256()


def deciding(config: dict[str, Any]) -> dict[str, Any]:
    """What of a config.json decides a run's numbers."""
    versions = {name: version for name, version in config.get("versions", {}).items() if name not in ("commit", "qrl")}
    return {name: config.get(name) for name in ("task", "learner", "seed", "seeds")} | {"versions": versions}


def sha256() -> str:
    """Of all sources that decide what a run's numbers are. A plot may change, and the runs stay."""
    found = hashlib.sha256()
    for name, path in sorted(sources().items()):
        found.update(f"{name}\0".encode() + path.read_bytes() + b"\0")
    return found.hexdigest()


def sources() -> dict[str, Path]:
    """Module -> file of TRAINING and whatever of our two packages they import."""
    found: dict[str, Path] = {}
    ahead = list(TRAINING)
    while ahead:
        name = ahead.pop()
        path = _file(name)
        if path and name not in found:
            found[name] = path
            ahead += _imports(path)
    return found


def _file(name: str) -> Path | None:
    room, _, rest = name.partition(".")
    path = ROOMS[room] / f"{rest.replace('.', '/')}.py" if room in ROOMS and rest else None
    return path if path and path.is_file() else None


def _imports(path: Path) -> list[str]:
    names = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return names


# How a run is made


def train(one: RunSpec, folder: Path, env: dict[str, str] | None = None) -> float:
    """Make the run as a user would, in a process of its own; an unfinished one of the same is gone on with.

    Returns its seconds; raises Failed. What else the folder held is removed.
    """
    words = [*one.words, "--out", str(folder)]
    if is_same(folder, one.config()):
        words.append("--resume")
    else:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        (folder / CODE).write_text(sha256())
    begun = time.perf_counter()
    qrl(words, env)
    return time.perf_counter() - begun


def qrl(words: list[str], env: dict[str, str] | None = None) -> None:
    """The command line in a process of its own, with `env` added to its environment; Failed if it fails."""
    command = [sys.executable, "-m", "qrl", *words]
    # In a session of its own, so that Ctrl-C reaches it once: through us.
    with subprocess.Popen(command, env=environment() | (env or {}), start_new_session=True) as process:
        try:
            code = process.wait()
        except BaseException:
            process.terminate()  # it saves, and then ends
            process.wait()
            raise
    if code:
        raise Failed(f"qrl {' '.join(words)} ended with exit code {code}")


def environment() -> dict[str, str]:
    """Of a run's process: this code's own packages, whatever is installed."""
    paths = os.pathsep.join([str(ROOT / "src"), str(ROOT / "envs"), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": paths}


# What a run says


def rows(folder: Path) -> list[Rows]:
    """metrics.csv of each seed."""
    config = tasks.load_run_config(folder)
    found = [files.read_metrics(member) for member in record.member_folders(folder, config)]
    return [[dict(row) for row in one] for one in found]


def reports(folder: Path, column: str) -> tuple[Any, Any]:
    """A column of all seeds' reports: environment steps [x] and values [seeds, x]."""
    return learning_curve.aligned(rows(folder), column)
