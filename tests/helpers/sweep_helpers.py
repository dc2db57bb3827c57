"""Small sweeps: their files, their tables, a chunk of one."""

import csv
import json
from pathlib import Path
from typing import Any

from cli_helpers import TINY_VALUES
from qrl.sweep.grid import Grid
from qrl.sweep.runner import Chunk, Member
from qrl.training.state import member_inputs
from qrl_envs import env as worlds

Rows = list[dict[str, str]]


def write_grid(folder: Path, axes: dict[str, Any], **more: Any) -> Path:
    path = folder / "grid.json"
    path.write_text(json.dumps({"task": "pendulum", "fixed": TINY_VALUES, "axes": axes, "seeds": [0, 3], **more}))
    return path


def rows_of(path: Path) -> Rows:
    """A table without its clocks."""
    with path.open() as file:
        return [
            {k: v for k, v in row.items() if not k.endswith(("_seconds", "_per_second"))}
            for row in csv.DictReader(file)
        ]


def chunk_of(grid: Grid, seeds: int) -> Chunk:
    """The first point of a grid of pendulums, with seeds from 0."""
    point, inputs = grid.points[0], member_inputs(worlds.make("pendulum"), grid.points[0].learner)
    members = [Member(i, i, inputs) for i in range(seeds)]
    return Chunk(point.task, point.learner, point.static, members, seeds, 0, 1)
