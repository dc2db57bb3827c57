"""The runs behind the figures: which there are, whether they are current, and how they are trained."""

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
TRAINING = ("qrl.training.driver", "qrl_envs.env")  # with all that they import: the code that decides a run's numbers
CODE = "code.sha256"  # in a run's folder: the hash of the code that trained it

FIRST_SEED = 100  # held out: none was tuned on
SEEDS, FAST_SEEDS = 10, 2  # even, so that two cores share them
# Schulman et al. 2017: eight whole passes over the last unroll of 16 lanes, the ratio clipped at 0.2, GAE(0.95). What
# differs: no entropy bonus, and the step size and sigma of the method that it stands beside.
PPO = {
    "replay_unrolls": 1,
    "warmup_unrolls": 1,
    "sampling": "epochs",
    "symmetries": False,
    "advantage": "mu",
    "lam": 0.95,
    "epsilon": 0.2,
    "updates_per_unroll": 16,
    "batch_size": 8,
}
PAPER_RATES = {"high": 1e-4, "low": 0.5e-5}
NO_APG = {"apg_fraction": 0.0}  # the paper's learner, with symmetries
RATIO = PAPER_RATES["high"] / PAPER_RATES["low"]


class Failed(RuntimeError):
    """A run ended with an error; the message is one line."""


class RunSpec(NamedTuple):
    """A run that a figure needs."""

    name: str  # of its folder, too
    task: str
    preset: str  # whose values the flags override
    flags: dict[str, Any]  # of `qrl train`, by the names of qrl.config
    seeds: int = 1
    seed: int = FIRST_SEED

    @property
    def words(self) -> list[str]:
        """The command, without its --out."""
        preset = [] if self.preset == self.task else ["--preset", self.preset]
        flags = [
            w
            for name, value in self.flags.items()
            for w in (f"--{name.replace('_', '-')}", json.dumps(value).strip('"'))
        ]
        return ["train", self.task, "--seed", str(self.seed), "--seeds", str(self.seeds), *preset, *flags]

    def config(self) -> RunConfig:
        """The config.json of this run if it were trained now."""
        return request.run_config(self.task, None, ConfigFile(), self.flags, self.seed, self.seeds, preset=self.preset)


def plan(*, fast: bool) -> list[RunSpec]:
    """All runs, the fastest tasks first."""
    seeds = FAST_SEEDS if fast else SEEDS
    found = pendulums("pendulum_fast" if fast else "pendulum", seeds, paper=not fast)
    if fast:
        return [
            *found,
            RunSpec("hover", "hover", "hover_fast", NO_APG | {"num_timesteps": 384_000}, seeds),
            RunSpec("circle", "circle", "circle_fast", NO_APG | {"num_timesteps": 1_200_000}, seeds),
        ]
    return [
        *found,
        RunSpec("hover", "hover", "hover", NO_APG | {"num_timesteps": 1_500_000, "num_evals": 25}, seeds),
        RunSpec("circle", "circle", "circle_fast", NO_APG | {"num_timesteps": 2_400_000, "num_evals": 20}, seeds),
        RunSpec("hover-flight", "hover", "hover", NO_APG | {"num_timesteps": 4_500_000}),
        RunSpec("circle-flight", "circle", "circle", NO_APG | {"num_timesteps": 4_500_000}),
    ]


def pendulums(preset: str, seeds: int, *, paper: bool) -> list[RunSpec]:
    """Both methods at two rates around the recipe's own; with `paper` at the paper's two rates too, held constant.

    Neither is augmented by symmetries, which the paper's method does not have: what is compared is the objective.
    """
    recipe = {name: load_preset(preset)[name] for name in ("learning_rate", "learning_rate_end")}
    rates = {"high": recipe, "low": {name: float(f"{value / RATIO:.6g}") for name, value in recipe.items()}}
    if paper:
        constant = {name: {"learning_rate": r, "learning_rate_end": r} for name, r in PAPER_RATES.items()}
        rates |= {f"paper-{name}": rate for name, rate in constant.items()}
    methods = {"": {"symmetries": False}, "-ppo": PPO}
    return [
        RunSpec(f"pendulum-{rate}{method}", "pendulum", preset, flags | more, seeds)
        for rate, flags in rates.items()
        for method, more in methods.items()
    ]


# Whether a run is current


def is_current(folder: Path, run: RunConfig) -> bool:
    """Whether `folder` holds this run, finished, trained by the present code and versions."""
    return (folder / "summary.json").exists() and is_same(folder, run)


def is_same(folder: Path, run: RunConfig) -> bool:
    """Whether `folder` holds this run, finished or not. Devices and commit may differ."""
    try:
        stored = json.loads((folder / "config.json").read_text())
        code = (folder / CODE).read_text()
    except (OSError, ValueError):
        return False
    return isinstance(stored, dict) and deciding(stored) == deciding(run.model_dump(mode="json")) and code == sha256()


def deciding(config: dict[str, Any]) -> dict[str, Any]:
    """The part of a config.json that decides a run's numbers."""
    versions = {name: version for name, version in config.get("versions", {}).items() if name not in ("commit", "qrl")}
    return {name: config.get(name) for name in ("task", "learner", "seed", "seeds")} | {"versions": versions}


def sha256() -> str:
    """The hash of all sources that decide a run's numbers; a plot's code may change without making runs stale."""
    found = hashlib.sha256()
    for name, path in sorted(sources().items()):
        found.update(f"{name}\0".encode() + path.read_bytes() + b"\0")
    return found.hexdigest()


def sources() -> dict[str, Path]:
    """Module -> file of TRAINING and all that they import of our two packages."""
    found: dict[str, Path] = {}
    pending = list(TRAINING)
    while pending:
        name = pending.pop()
        path = _file(name)
        if path and name not in found:
            found[name] = path
            pending += _imports(path)
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


# Train


def train(one: RunSpec, folder: Path, env: dict[str, str] | None = None) -> float:
    """Train the run with `qrl train`, in a process of its own, or resume it if it is unfinished; returns the seconds.

    Another run in the folder is removed. Raises Failed.
    """
    words = [*one.words, "--out", str(folder)]
    if is_same(folder, one.config()):
        words.append("--resume")
    else:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        (folder / CODE).write_text(sha256())
    start = time.perf_counter()
    qrl(words, env)
    return time.perf_counter() - start


def qrl(words: list[str], env: dict[str, str] | None = None) -> None:
    """The command line in a process of its own, with `env` added to its environment; Failed if it fails."""
    command = [sys.executable, "-m", "qrl", *words]
    # In a session of its own, so that Ctrl-C reaches it only once, by `terminate`.
    with subprocess.Popen(command, env=environment() | (env or {}), start_new_session=True) as process:
        try:
            code = process.wait()
        except BaseException:
            process.terminate()  # it saves and exits
            process.wait()
            raise
    if code:
        raise Failed(f"qrl {' '.join(words)} ended with exit code {code}")


def environment() -> dict[str, str]:
    """The environment of a run's process, in which this checkout's packages take precedence."""
    paths = os.pathsep.join([str(ROOT / "src"), str(ROOT / "envs"), *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": paths}


# Read


def rows(folder: Path) -> list[Rows]:
    """metrics.csv of each seed."""
    config = tasks.load_run_config(folder)
    found = [files.read_metrics(member) for member in record.member_folders(folder, config)]
    return [[dict(row) for row in one] for one in found]


def reports(folder: Path, column: str) -> tuple[Any, Any]:
    """A column of all seeds' reports: environment steps [x] and values [seeds, x]."""
    return learning_curve.aligned(rows(folder), column)
