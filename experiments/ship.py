"""Put a trained run into the package, where `RUN=NAME` finds it: its settings and the learner of its last checkpoint.

.venv/bin/python -m experiments.ship RUN [NAME]
"""

import json
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np

from experiments.arguments import Parser, run_main
from qrl import tasks
from qrl.cli.main import configure_jax
from qrl.cli.terminal import DONE
from qrl.evaluation.flight_programs import FlightPrograms
from qrl.runs import checkpoint, shipped
from qrl.runs.checkpoint import Checkpoint, Record
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
    folder = shipped.SHIPPED / (args.name or config.task.name)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    shutil.copy(args.run / "config.json", folder)
    nothing: Any = [None] * len(TrainState._fields)
    state = TrainState(*nothing)._replace(learner=jax.tree.map(lambda x: np.asarray(x[0]), learner))
    writer = checkpoint.Writer(folder, config)
    writer.save(Checkpoint(env_steps, state, Record([], 0.0, 0.0)))
    writer.wait()
    writer.close()
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    print(json.dumps({"folder": str(folder), "bytes": size, "env_steps": env_steps}))
    return DONE


if __name__ == "__main__":
    configure_jax()
    run_main("ship", main)
