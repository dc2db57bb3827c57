"""The paper's six figures from runs of this code, with captions: `make figures`, or `make figures FAST=1`.

    .venv/bin/python -m experiments.figures.make [--fast] [--out FOLDER] [--only pendulum hover …] [--fresh]

Leaves NAME.png, NAME.svg and NAME.md for each figure, and the runs in OUT/runs. Runs are trained by `qrl train`, one
at a time; a finished run of the same code is kept, an unfinished one is resumed.
"""

import functools
import shlex
import shutil
import sys
import time
from pathlib import Path
from typing import NamedTuple

import jax
from matplotlib.figure import Figure

from experiments.arguments import Parser, run_main
from experiments.figures import captions
from experiments.figures import plots as draw
from experiments.figures.captions import Caption, Provenance
from experiments.figures.flights import PolicyFlights, fly_policy
from experiments.figures.plots import SHOWN, Curves, Rate
from experiments.figures.runs import PAPER_RATES, Failed, RunSpec, is_current, reports, train
from experiments.figures.runs import plan as planned
from qrl import tasks
from qrl.algorithm.adapter import adapt
from qrl.cli.terminal import DONE, FAILED
from qrl.runs import files, record
from qrl_envs.specfile import BadInput, nearest

FIGURES = {  # name -> name of its run, or prefix of the names of its runs; the first that exists
    "pendulum": ("pendulum-",),
    "hover": ("hover",),
    "hover_trial": ("hover-flight", "hover"),
    "circle": ("circle",),
    "circle_from_above": ("circle-flight", "circle"),
    "circle_velocity": ("circle-flight", "circle"),
}
OUT = Path("experiments/out/figures")
COMMAND = ("python", "-m", "experiments.figures.make")


class Source(NamedTuple):
    """A run and its folder."""

    run: RunSpec
    folder: Path


def main(argv: list[str] | None = None) -> int:
    words = sys.argv[1:] if argv is None else argv
    parser = Parser("figures", __doc__)
    parser.add_argument("--fast", action="store_true", help="shorter runs, fewer seeds")
    parser.add_argument("--out", type=Path, help=f"({OUT}; with --fast {OUT}_fast)", metavar="FOLDER")
    parser.add_argument("--only", nargs="+", default=list(FIGURES), help=", ".join(FIGURES), metavar="NAME")
    parser.add_argument("--fresh", action="store_true", help="train all runs again")
    args = parser.parse_args(words)
    for name in args.only:
        if name not in FIGURES:
            parser.error(f"--only: no figure '{name}'{nearest(name, list(FIGURES))}")
    out: Path = args.out or (OUT.with_name(f"{OUT.name}_fast") if args.fast else OUT)
    parser.check_folder("--out", out)
    command = "make figures" if words in ([], ["--fast"]) else shlex.join([*COMMAND, *words])
    try:
        figures(args.only, out, command + " FAST=1" * (words == ["--fast"]), fast=args.fast, fresh=args.fresh)
    except (OSError, Failed, BadInput) as error:
        print(f"figures: {error}", file=sys.stderr)
        return FAILED
    return DONE


def figures(names: list[str], out: Path, command: str, *, fast: bool, fresh: bool) -> dict[str, Caption]:
    """Draw each figure as soon as its runs are finished; their captions."""
    start = time.perf_counter()
    plan, there, found = planned(fast=fast), set[str](), dict[str, Caption]()
    fly = functools.cache(fly_policy)
    note = " (FAST: shorter runs and fewer seeds than those of `make figures`)" if fast else ""
    for name in names:
        sources = [Source(run, out / "runs" / run.name) for run in needed(name, plan)]
        for run, folder in sources:
            if run.name not in there:
                ensure_run(run, folder, fresh=fresh)
                there.add(run.name)
        figure, caption = draw_figure(name, sources, fly)
        found[name] = caption
        draw.save(figure, out / name)
        files.replace_text(
            out / f"{name}.md", captions.page(caption, Provenance(command, record.commit(), note, sources))
        )
        print(f"figures: {out / name}.png, .svg, .md: {caption.verdict}", flush=True)
    print(f"figures: done in {time.perf_counter() - start:.0f} s", flush=True)
    return found


def needed(name: str, plan: list[RunSpec]) -> list[RunSpec]:
    """The runs of `plan` that the figure `name` is drawn from."""
    for prefix in FIGURES[name]:
        many = prefix.endswith("-")
        if found := [one for one in plan if one.name == prefix or (many and one.name.startswith(prefix))]:
            return found
    raise AssertionError(name)


def ensure_run(run: RunSpec, folder: Path, *, fresh: bool) -> None:
    """Train the run unless it is current."""
    if fresh:
        shutil.rmtree(folder, ignore_errors=True)
    if is_current(folder, run.config()):
        print(f"figures: {folder}: current", flush=True)
        return
    print(f"figures: qrl {' '.join(run.words)}", flush=True)
    print(f"figures: {folder}: trained in {train(run, folder):.0f} s", flush=True)


def draw_figure(
    name: str, sources: list[Source], fly: "functools._lru_cache_wrapper[PolicyFlights]"
) -> tuple[Figure, Caption]:
    first = sources[0].folder
    if name == "pendulum":
        found = rates(sources)
        return draw.pendulum(found), captions.pendulum(found)
    if name == "hover":
        found = curves(sources[0])
        return draw.hover(found), captions.hover(found)
    if name == "circle":
        found, config = curves(sources[0]), tasks.load_run_config(first)
        longest = config.learner.episode_length or adapt(tasks.environment(config.task)).episode_steps
        return draw.circle(found), captions.circle(found, longest)
    if name == "hover_trial":
        flights = fly(first, trial=True)
        return draw.trial(flights), captions.trial(flights)
    flights = fly(first)
    if name == "circle_from_above":
        return draw.from_above(flights), captions.from_above(flights, SHOWN)
    return draw.velocity(flights), captions.velocity(flights)


def curves(source: Source, label: str = "") -> Curves:
    steps, returns = reports(source.folder, "return_mean")
    _, success = reports(source.folder, "success")
    return Curves(label or f"IQM of {len(returns)} seeds", steps, returns, success)


def rates(sources: list[Source]) -> list[Rate]:
    """Both methods' curves at each rate, the paper's first."""
    by_name = {source.run.name: source for source in sources}
    found = []
    for source, infix in (("the paper's learning rates", "paper-"), ("this recipe's learning rates", "")):
        for which in PAPER_RATES:
            name = f"pendulum-{infix}{which}"
            if name in by_name:
                rate = by_name[name].run.flags["learning_rate"]
                ours = curves(by_name[name], f"ours, {rate:g}")
                ppo = curves(by_name[f"{name}-ppo"], f"PPO, {rate:g}")
                found.append(Rate(f"{source}: {which}, {rate:g}", ours, ppo))
    return found


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")  # a GPU is the runs'
    run_main("figures", main)
