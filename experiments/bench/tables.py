"""From runs to medians, ranges and ratios, and to a page of tables.

A run is what one process left: {"contestant", "group", "seed", "outcome", "lines"}; a line is a check or a figure.
"""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from experiments.bench.contestants import GROUPS, QRL
from experiments.output import table

Run = dict[str, Any]
CLOCKS = ("steps", "train_seconds", "compile_seconds", "total_seconds")
BARS = {"pendulum": ("return_mean", -150.0), "hover": ("success", 0.99), "circle": ("success", 0.99)}
# Suffixes of a contestant's name, and so of its figures.
ONE_CORE, EACH_CORE, TWO_DEVICES = ", one core", ", a process a core", ", two devices"
REAL = "real plant, "  # prefix of a figure of a plant with lag, drag and sensors
EASIER_PENDULUM = -160.0  # the threshold of published figures
TUNED = (
    "**Settings.** qrl trains with presets tuned for just these tasks (`pendulum_fast`, `hover_fast`,"
    " `circle_fast`); its commands use the tasks' default presets. On hover and circle these end with the analytic"
    " policy gradient (APG), which no other contestant here uses; its environment steps count as steps; *qrl without"
    " APG* is the same presets without it. qrl makes a device of each core, or has XLA use one thread where its"
    " minibatches are small, as `qrl train` does; every other contestant has its own default devices and threads. Brax"
    " PPO's settings were tuned by hand for the pendulum, as Brax ships none that suit; on hover and circle it has the"
    " same with more environments, longer unrolls and a higher discount, without a search there. rejax: its own for"
    " this task. sbx: the RL Zoo's for this task. rltools: the package's defaults, made for this task. Rates: a call of"
    " qrl makes 16,384 × 50 environment steps; one of the others makes an unroll."
)


class Spread(NamedTuple):
    """Median and range; infinite where a run did not reach it."""

    median: float
    min: float
    max: float


def spread(values: Iterable[float]) -> Spread:
    """Of at least one value."""
    ordered = np.sort(np.fromiter(values, float))
    return Spread(float(np.median(ordered)), float(ordered[0]), float(ordered[-1]))


def first_at(run: Run, name: str, bar: float) -> dict[str, float] | None:
    """A run's first check at which `name` is at least `bar`; NaN never does."""
    return next((line for line in run["lines"] if line.get(name) is not None and line[name] >= bar), None)


def to_solve(run: Run, clock: str, bar: float | None = None) -> float:
    """The value of `clock` at which the run's task was solved; infinite if it never was."""
    name, usual = BARS[run["group"]]
    line = first_at(run, name, usual if bar is None else bar)
    return math.inf if line is None else float(line.get(clock, math.nan))


def ratios(other: dict[int, float], ours: dict[int, float]) -> Spread | None:
    """Of values by seed, each over ours of the same round (run one after the other); None: no round has both.

    Where ours is infinite the ratio says nothing, and that round is left out.
    """
    both = [other[seed] / ours[seed] for seed in other if seed in ours and 0 < ours[seed] < math.inf]
    return spread(both) if both else None


def number(value: float) -> str:
    """Three digits, or a dash for infinity and NaN."""
    if not math.isfinite(value):
        return "–"
    if value and abs(value) < 100:
        return f"{value:.3g}"
    return f"{value:,.0f}" if abs(value) < 1e6 else f"{value / 1e6:.3g}M"


def cell(found: Spread | None, unit: str = "") -> str:
    """median [min … max]; "not" where most runs did not reach it."""
    if found is None:
        return "–"
    if not math.isfinite(found.median):
        return "not" if not math.isfinite(found.min) else f"not [{number(found.min)}{unit} … –]"
    return f"{number(found.median)}{unit} [{number(found.min)} … {number(found.max)}]"


def _names(runs: list[Run]) -> list[str]:
    return list(dict.fromkeys(run["contestant"] for run in runs))


def by_seed(runs: list[Run], contestant: str, clock: str, bar: float | None = None) -> dict[int, float]:
    return {run["seed"]: to_solve(run, clock, bar) for run in runs if run["contestant"] == contestant}


def race(runs: list[Run], group: str) -> str:
    """The table of a group whose contestants train until the task is solved."""
    name, bar = BARS[group]
    easier = [EASIER_PENDULUM] if group == "pendulum" else []
    head = ["", "solved", "steps", "training [s]", "compiling [s]", "total [s]", "training / qrl", "total / qrl"]
    head += ["training [s] to −160"] * len(easier)
    rows = []
    for contestant in _names(runs):
        selected = [run for run in runs if run["contestant"] == contestant]
        solved = sum(first_at(run, name, bar) is not None for run in selected)
        row = [
            contestant,
            f"{solved} of {len(selected)}",
            *(cell(spread(by_seed(runs, contestant, c).values())) for c in CLOCKS),
        ]
        for clock in ("train_seconds", "total_seconds"):
            row.append(
                ""
                if contestant == QRL
                else cell(ratios(by_seed(runs, contestant, clock), by_seed(runs, QRL, clock)), "×")
            )
        row += [cell(spread(by_seed(runs, contestant, "train_seconds", b).values())) for b in easier]
        rows.append(row)
    return table(head, rows)


def commands(runs: list[Run]) -> str:
    """The table of complete commands: a row for each measure of their last line."""
    names = list(dict.fromkeys(name for run in runs for name in _last(run)))
    each = {contestant: [_last(run) for run in runs if run["contestant"] == contestant] for contestant in _names(runs)}
    rows = [[name.replace("_", " "), *(_of(lines, name) for lines in each.values())] for name in names]
    return table(["", *each], rows)


def _last(run: Run) -> dict[str, float]:
    return run["lines"][-1] if run["lines"] else {}


def _of(lines: list[dict[str, float]], name: str) -> str:
    values = [line[name] for line in lines if line.get(name) is not None]
    return cell(spread(values)) if values else "–"


def figures(runs: list[Run]) -> dict[str, dict[str, dict[int, float]]]:
    """Of the group `speed`: figure -> contestant -> value by seed. A number of devices or cores in the
    contestant's name ("qrl, one core") becomes part of the figure's name.
    """
    found: dict[str, dict[str, dict[int, float]]] = {}
    for run in runs:
        contestant, *how = run["contestant"].split(", ")
        for line in run["lines"]:
            value = line.get("per_second", line.get("seconds"))
            figure = ", ".join([line["figure"], *how])
            found.setdefault(figure, {}).setdefault(contestant, {})[run["seed"]] = float(value)
    return found


def speed(runs: list[Run]) -> str:
    """A row for each figure and contestant, with the ratio of qrl's rate at its default devices to it."""
    found, rows = figures(runs), []
    for figure, values in found.items():
        ours = found.get(strip_device_suffix(figure), {}).get(QRL, {})
        for contestant, other in values.items():
            ratio = None if contestant == QRL else ratios(ours, other)
            rows.append([figure, contestant, cell(spread(other.values())), cell(ratio, "×") if ratio else ""])
    return table(["", "", "a second, or seconds", "qrl / this"], rows)


def strip_device_suffix(figure: str) -> str:
    """The figure's name without its number of devices or cores."""
    return figure.removesuffix(ONE_CORE).removesuffix(EACH_CORE).removesuffix(TWO_DEVICES)


def derived(runs: list[Run]) -> str:
    """Ratios within a contestant: of numbers of devices or cores, and the cost of acting by lanes."""
    found, rows = figures(runs), []
    for figure, values in found.items():
        plain = strip_device_suffix(figure)
        for contestant, given in values.items():
            by_itself, one_core = (found.get(plain + how, {}).get(contestant, {}) for how in ("", ONE_CORE))
            if figure.endswith(TWO_DEVICES):
                rows.append([f"{figure}, over its default", contestant, cell(ratios(given, by_itself), "×")])
            elif figure.endswith(ONE_CORE):
                rows.append([f"{plain}, its default over one core", contestant, cell(ratios(by_itself, given), "×")])
            elif figure.endswith(EACH_CORE):
                rows.append([f"{figure}, over one core", contestant, cell(ratios(given, one_core), "×")])
    for figure, values in found.items():
        if (ideal := found.get(figure.removeprefix(REAL), {}).get(QRL)) and figure.startswith(REAL):
            rows.append([f"{figure}, over the ideal plant", QRL, cell(ratios(values[QRL], ideal), "×")])
    acting = [values for figure, values in found.items() if figure.startswith("acting, ")]
    for contestant in dict.fromkeys(contestant for values in acting for contestant in values):
        each = [values[contestant] for values in acting if contestant in values]
        seeds = set.intersection(*(set(rates) for rates in each))
        high, low = ({s: f(rates[s] for rates in each) for s in sorted(seeds)} for f in (max, min))
        label = f"acting, a step's highest cost over its lowest, of {len(each)} numbers of lanes"
        rows.append([label, contestant, cell(ratios(high, low), "×")])
    return table(["", "", "ratio"], rows) if rows else ""


def page(runs: list[Run], absent: dict[str, str], machine: dict[str, Any]) -> str:
    """bench.md."""
    described = "; ".join(f"{name} {value}" for name, value in machine.items())
    parts = ["# qrl beside other trainers and simulators", f"{described}."]
    if len(commits := sorted({run["commit"] for run in runs if "commit" in run})) > 1:
        parts.append(f"**Runs of several commits**: {', '.join(commits)}. `--fresh` repeats all.")
    parts.append(
        "Median [min … max] over seeds. A ratio is of runs of one seed, made one after the other; its median and range"
        " are over seeds too. *not*: most runs did not solve it within their budget."
        " Clocks: experiments/baselines/judge.py."
    )
    parts.append(TUNED)
    for group, title in GROUPS.items():
        selected = [run for run in runs if run["group"] == group]
        if selected:
            made = (
                race(selected, group)
                if group in BARS
                else commands(selected)
                if group == "commands"
                else speed(selected)
            )
            parts += [f"## {title}", made]
            if group == "speed" and (more := derived(selected)):
                parts.append(more)
    broken = [run for run in runs if run["outcome"] not in ("done", "out of time")]
    if absent or broken:
        problems = [f"- {name}: not installed: {why}" for name, why in absent.items()]
        problems += [
            f"- {r['group']}/{r['contestant']}, seed {r['seed']}: {r['outcome']}: {r.get('error', '')}" for r in broken
        ]
        parts += ["## Absent, or failed", "\n".join(problems)]
    return "\n\n".join(parts) + "\n"
