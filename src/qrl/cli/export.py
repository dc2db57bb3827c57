"""`qrl export`: a run's policy as a C kernel, proved, measured and flown."""

import argparse
import time

from qrl.cli.terminal import DONE, clock, console
from qrl.evaluation import trained_run
from qrl.export.report import gates


def export(args: argparse.Namespace) -> int:
    """Emit, prove and fly a run's integer policy; print gates and costs, leave it all in RUN/export."""
    begun = time.perf_counter()
    done = trained_run.export(trained_run.Run(args.run), args.starts, args.vectors, console.print)
    proof = done.measured.proof
    for name in proof.held:
        console.print(f"held against the reference, bit for bit, on {proof.vectors:,} observations an entry: {name}")
    for what in proof.missing:
        console.print(f"NOT proved {what}")
    for gate in gates(done.measured):
        mark = "met" if gate.met else "MISSED"
        console.print(f"{gate.name:<40} {gate.measured:>9.3g} {gate.unit:<20} bar {gate.bar:<6g} {mark}")
    if proof.costs:
        console.print(
            f"{'instructions per inference':<27} {'float entry':>12} {'i16 entry':>10} {'flash':>8} {'stack':>7}"
        )
    for cost in proof.costs:
        mean, mean_i16 = cost.step[0], cost.step_i16[0]
        console.print(f"{cost.core:<27} {mean:>12,.0f} {mean_i16:>10,.0f} {cost.flash:>6,} B {max(cost.stack):>5} B")
    console.print(f"done in {clock(time.perf_counter() - begun)}: {done.folder}/qrl_policy.c, .h, report.md")
    return DONE
