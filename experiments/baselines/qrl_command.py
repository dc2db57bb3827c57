"""The command as a user has it, defaults as they ship: `qrl_command.py TASK --seed N`.

`qrl train TASK` in a process of its own, with an empty compile cache, then `qrl evaluate` of the final policy, not of
the first that was good enough, from 1,000 fresh starts. `worst_of_5_…` is the maximum steady-state error of the last 5
checkpoints; a quadrotor is evaluated off nominal too. train_seconds are the run's own; total_seconds are those of the
`qrl train` process, checkpoints, reports and plots included; `other_seconds` are the difference.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from judge import report

MEASURES = ("success", "settle_median_s", "settle_p95_s", "return_mean")
CHECKPOINTS = 5
QUADROTORS = ("hover", "circle")


def summary(found: dict[str, Any]) -> dict[str, float | None]:
    """The measures of an evaluation.json; None: not finite."""
    steady = [name for name in found if name.startswith("rms_")]
    of_each = {name: [one[name] for one in found["checkpoints"]] for name in steady}
    return {
        **{name: value for name, value in found.items() if name in MEASURES or name in steady},
        **{f"worst_of_{len(v)}_{name}": None if None in v else max(v) for name, v in of_each.items()},
        **{f"off_nominal_success_{name}": one["success"] for name, one in found.get("off_nominal", {}).items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("task", choices=["pendulum", *QUADROTORS])
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "cache")}

        def qrl(*words: str) -> float:
            start = time.time()
            subprocess.run([sys.executable, "-m", "qrl", *words], env=env, check=True, stdout=sys.stderr)
            return time.time() - start

        seconds = qrl("train", args.task, "--seed", str(args.seed), "--out", str(out))
        off = ["--off-nominal"] if args.task in QUADROTORS else []
        qrl("evaluate", str(out), "--checkpoints", str(CHECKPOINTS), *off)
        last = json.loads((out / "summary.json").read_text())["result"]
        found = json.loads((out / "evaluation.json").read_text())
    report(
        {
            "steps": last["env_steps"],
            "train_seconds": last["train_seconds"],
            "total_seconds": seconds,
            "other_seconds": seconds - last["train_seconds"],
            **summary(found),
        }
    )


if __name__ == "__main__":
    main()
