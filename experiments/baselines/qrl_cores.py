"""The training loop of processes that exchange nothing, each pinned to a core: `qrl_cores.py [--processes N] --seed N`.

As many as there are cores, or N. Their rates (`throughput.py --only training`), summed: one process is one thread of
qrl; one a core is the most that more devices than one could reach on this machine.
"""

import argparse
import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

from judge import report

SCRIPT = Path(__file__).parents[1] / "profiling" / "throughput.py"
MARK = "BENCH "


def rates(output: str) -> dict[str, float]:
    """The figures that a process printed, by name."""
    lines = [json.loads(line.removeprefix(MARK)) for line in output.splitlines() if line.startswith(MARK)]
    return {line["figure"]: line["per_second"] for line in lines}


def summed(each: list[dict[str, float]]) -> dict[str, float]:
    """The processes' figures, added up."""
    return {figure: sum(one[figure] for one in each) for figure in each[0]}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--processes", type=int)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    words = [sys.executable, str(SCRIPT), "--only", "training", "--seed", str(args.seed)]
    if not hasattr(os, "sched_setaffinity"):
        sys.exit("expected Linux: here no process can be pinned to a core")
    cores = sorted(os.sched_getaffinity(0))[: args.processes]
    processes = [
        subprocess.Popen(words, stdout=subprocess.PIPE, text=True, preexec_fn=partial(os.sched_setaffinity, 0, {core}))
        for core in cores
    ]
    each = [rates(process.communicate()[0]) for process in processes]
    if any(process.returncode for process in processes):
        sys.exit("a process failed: its message is above")
    for figure, per_second in summed(each).items():
        report({"figure": figure, "per_second": per_second})


if __name__ == "__main__":
    main()
