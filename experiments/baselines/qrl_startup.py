"""Seconds from the command to the first updates: `qrl_startup.py [TASK] --seed N`.

`qrl train TASK` for the steps of the warm-up and one unroll's updates, timed until its first report is printed (which
flies 100 starts), first with an empty compile cache and then with the one that this run has filled.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from judge import report
from qrl.config import load_preset


def first_report(task: str, seed: int, out: Path, cache: Path) -> float:
    """Seconds until the command's first line that begins with a number of steps."""
    config = load_preset(task)
    steps = config["warmup_unrolls"] * config["num_envs"] * config["unroll_length"]
    words = ["train", task, "--seed", str(seed), "--num-timesteps", str(steps), "--num-evals", "1", "--out", str(out)]
    env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(cache), "PYTHONUNBUFFERED": "1"}
    start = time.time()
    command = [sys.executable, "-m", "qrl", *words]
    with subprocess.Popen(command, env=env, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.strip()[:1].isdigit():
                seconds = time.time() - start
                process.send_signal(signal.SIGKILL)
                return seconds
    raise SystemExit(f"qrl {' '.join(words)}: no report")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("task", nargs="?", default="hover")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for figure in ("empty compile cache", "warm compile cache"):
            seconds = first_report(args.task, args.seed, Path(folder) / figure, Path(folder) / "cache")
            report({"figure": f"command to first updates, {figure}", "seconds": seconds})


if __name__ == "__main__":
    main()
