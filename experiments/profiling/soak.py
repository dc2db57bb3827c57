"""One long run of hover, without APG: memory must not grow, nothing may compile midway, the return must not collapse.

    .venv/bin/python -m experiments.profiling.soak [--steps 2e8] [--hours 1] [--out experiments/out/soak]

Ends at the steps or the hours, whichever comes first, and leaves soak.csv (a row a report) and soak.json (the verdict)
beside the run folder; exit code 1 if one of them fails.
"""

import json
import os
import sys
import time
from pathlib import Path

import jax
import numpy as np

from experiments.arguments import Parser
from qrl import request, tasks
from qrl.runs import files, record
from qrl.training import devices, driver, loop

REPORT_STEPS = 1_000_000
SETTLED = 0.25  # fraction of the reports after which memory and return are checked
MEMORY_GROWTH = 1.02  # maximum, relative to the resident memory then
RETURN_LOSS = 0.05  # maximum drop, relative to the best return


def main() -> int:
    parser = Parser("soak", __doc__)
    parser.add_argument("--steps", type=float, default=2e8)
    parser.add_argument("--hours", type=float, default=1.0)
    parser.add_argument("--out", type=Path, default=Path("experiments/out/soak"))
    args = parser.parse_args()
    reports = max(4, round(args.steps / REPORT_STEPS))
    long = {"num_timesteps": args.steps, "num_evals": reports, "apg_fraction": 0.0}
    run = request.run_config("hover", None, record.ConfigFile(), long, 0, 1)
    devices.configure_cpu(run, [])
    if args.out.exists():
        print(f"{args.out}: exists already; give another --out", file=sys.stderr)
        return 2
    (args.out / "run").mkdir(parents=True)
    start, compiled, rows = time.perf_counter(), [0], []

    def count(event: str, duration_secs: float, **_: str | int) -> None:
        compiled[0] += event == "/jax/core/compile/backend_compile_duration"

    jax.monitoring.register_event_duration_secs_listener(count)

    def over() -> bool:
        return time.perf_counter() - start > 3600 * args.hours

    not_finite = ""
    try:
        for event in loop.train(tasks.environment(run.task), run, args.out / "run", resume=False, stopped=over):
            if isinstance(event, loop.Reported):
                report = {name: event.rows[0][name] for name in ("env_steps", "return_mean", "return_min", "success")}
                seconds = round(time.perf_counter() - start, 1)
                rows.append(report | {"seconds": seconds, "memory_MB": memory_MB(), "compilations": compiled[0]})
                print(rows[-1], flush=True)
                files.replace_text(args.out / "soak.csv", files.csv_text(rows))
    except driver.NotFinite as error:
        not_finite = str(error)
        print(not_finite, file=sys.stderr)
    if len(rows) < 4:
        print(f"too short to judge: {len(rows)} reports", file=sys.stderr)
        return 1
    found = verdict(rows)
    found["finite"] = {"kept": not not_finite, "found": not_finite}
    ran = {"env_steps": int(rows[-1]["env_steps"]), "seconds": rows[-1]["seconds"], "versions": run.versions}
    (args.out / "soak.json").write_text(json.dumps({**ran, **found}, indent=2) + "\n")
    print(json.dumps(found, indent=2))
    return 0 if all(check["kept"] for check in found.values()) else 1


def memory_MB() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 1e6, 1)


def verdict(rows: list[dict[str, float]]) -> dict[str, dict[str, object]]:
    """Each check with its reference, what was measured, and whether it was kept."""
    memory, compilations, returns = (
        np.array([row[name] for row in rows]) for name in ("memory_MB", "compilations", "return_mean")
    )
    settled = int(len(rows) * SETTLED)
    drop = float(np.max(np.maximum.accumulate(returns[settled:]) - returns[settled:]))
    best = float(returns.max())
    return {
        "memory_MB": {
            "settled": float(memory[settled]),
            "max_after": float(memory[settled:].max()),
            "kept": bool(memory[settled:].max() <= MEMORY_GROWTH * memory[settled]),
        },
        "compilations": {
            "second_report": int(compilations[1]),
            "last_report": int(compilations[-1]),
            "kept": bool(compilations[-1] == compilations[1]),
        },
        "return": {
            "best": best,
            "last": float(returns[-1]),
            "max_drop": drop,
            "kept": bool(drop <= RETURN_LOSS * abs(best)),
        },
    }


if __name__ == "__main__":
    sys.exit(main())
