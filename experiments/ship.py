"""Put a trained run into the package, where `RUN=NAME` finds it: its settings and the learner of its last checkpoint.

.venv/bin/python -m experiments.ship RUN [NAME]
"""

import json
import shutil
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.arguments import Parser, run_main
from qrl import tasks
from qrl.cli.main import configure_jax
from qrl.cli.terminal import DONE
from qrl.evaluation.flight_programs import FlightPrograms
from qrl.runs import checkpoint, integrity, shipped
from qrl.runs.checkpoint import Checkpoint, Record
from qrl.runs.record import RunConfig
from qrl.training.state import TrainState


def main(argv: list[str] | None = None) -> int:
    parser = Parser("ship", __doc__)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run of one seed")
    parser.add_argument("name", nargs="?", metavar="NAME", help="default: its task's")
    args = parser.parse_args(argv)
    if not (args.name or "x").isidentifier():
        parser.error("NAME: expected letters, digits and _")
    config = tasks.load_run_config(args.run)
    programs = FlightPrograms(tasks.environment(config.task), config.learner)
    learner, env_steps = next(programs.checkpoints(config, args.run, 1))
    target = shipped.SHIPPED / (args.name or config.task.name)
    target.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=target.parent) as work:
        folder = Path(work) / target.name
        folder.mkdir()
        shutil.copy(args.run / "config.json", folder)
        write_learner(folder, config, learner, env_steps)
        shutil.rmtree(target, ignore_errors=True)
        folder.rename(target)
    size = sum(path.stat().st_size for path in target.rglob("*") if path.is_file())
    print(json.dumps({"folder": str(target), "bytes": size, "env_steps": env_steps}))
    return DONE


def write_learner(folder: Path, config: RunConfig, learner: Any, env_steps: int) -> None:
    """A checkpoint of the learner alone (leading axis: one member)."""
    nothing: Any = [None] * len(TrainState._fields)
    state = TrainState(*nothing)._replace(learner=jax.tree.map(lambda x: np.asarray(x[0]), learner))
    with ThreadPoolExecutor(1) as thread:
        writer = checkpoint.Writer(folder, config, thread)
        writer.save(Checkpoint(env_steps, state, Record([], 0.0, 0.0)))
        writer.wait()
        writer.close()
    checkpoint_folder = folder / "checkpoints" / str(env_steps)
    for path in checkpoint_folder.rglob("commit_success.txt"):  # where Orbax wrote it is nobody's business
        path.write_text("Checkpoint commit was successful.\n")
    integrity.write_manifest(checkpoint_folder)


if __name__ == "__main__":
    configure_jax()
    run_main("ship", main)
