"""Seconds of many seeds: `qrl_seeds.py TASK [--preset PRESET] [--count 16] --seed N`.

`qrl train TASK --seeds COUNT` against COUNT commands of one seed each, one after the other; whole processes, with a
compile cache that a first short run of each kind has filled.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from judge import report


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("task")
    parser.add_argument("--preset")
    parser.add_argument("--count", type=int, default=16)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    preset = ["--preset", args.preset] if args.preset else []
    with tempfile.TemporaryDirectory() as folder:
        env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(Path(folder) / "cache")}

        def train(first: int, count: int) -> float:
            out = str(Path(folder) / f"{first}-{count}")
            words = ["train", args.task, *preset, "--seed", str(first), "--seeds", str(count), "--out", out]
            start = time.time()
            subprocess.run([sys.executable, "-m", "qrl", *words], env=env, check=True, stdout=sys.stderr)
            return time.time() - start

        for count in (1, args.count):
            train(args.seed + args.count, count)
        together = train(args.seed, args.count)
        apart = sum(train(args.seed + i, 1) for i in range(args.count))
    name = args.preset or args.task
    report({"figure": f"{args.count} seeds of {name} side by side", "seconds": together})
    report({"figure": f"{args.count} commands of one seed of {name}", "seconds": apart})


if __name__ == "__main__":
    main()
