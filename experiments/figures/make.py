"""The paper's six figures from runs of this code, each with a caption: `make figures`, or `make figures FAST=1`.

    .venv/bin/python -m experiments.figures.make [--fast] [--out FOLDER] [--only pendulum hover …] [--fresh]

Leaves NAME.png, NAME.svg and NAME.md for each figure, and the runs in OUT/runs. A run is made as a user would make it
(`qrl train`), one at a time; one that is finished and current is kept, an unfinished one gone on with.
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

from experiments.arguments import Parser, run_to_the_end
from experiments.figures import captions
from experiments.figures import plots as draw
from experiments.figures.captions import Caption, Made
from experiments.figures.flights import Flown, flown
from experiments.figures.plots import SHOWN, Curves, Rate
from experiments.figures.runs import PAPER_RATES, Failed, Wanted, current, make, reports, wanted
from qrl import tasks
from qrl.algorithm.adapter import adapt
from qrl.cli.terminal import DONE, FAILED
from qrl.runs import files, record
from qrl_envs.specfile import BadInput, nearest

FIGURES = {  # name -> the beginnings of the names of its runs; of several the first that there is
    "pendulum": ("pendulum-",),
    "hover": ("hover",),
    "hover_trial": ("hover-flight", "hover"),
    "circle": ("circle",),
    "circle_from_above": ("circle-flight", "circle"),
    "circle_velocity": ("circle-flight", "circle"),
}
OUT = Path("experiments/out/figures")


class Source(NamedTuple):
    """A run that is there, and its folder."""

    run: Wanted
    folder: Path


def main(argv: list[str] | None = None) -> int:
    words = sys.argv[1:] if argv is None else argv
    parser = Parser("figures", __doc__)
    parser.add_argument("--fast", action="store_true", help="shorter runs, fewer seeds")
    parser.add_argument("--out", type=Path, help=f"({OUT}; with --fast {OUT}_fast)", metavar="FOLDER")
    parser.add_argument("--only", nargs="+", default=list(FIGURES), help=", ".join(FIGURES), metavar="NAME")
    parser.add_argument("--fresh", action="store_true", help="make the runs again")
    args = parser.parse_args(words)
    for name in args.only:
        if name not in FIGURES:
            parser.error(f"--only: no figure '{name}'{nearest(name, list(FIGURES))}")
    out: Path = args.out or (OUT.with_name(f"{OUT.name}_fast") if args.fast else OUT)
    if out.exists() and not out.is_dir():
        parser.error(f"--out: {out} is a file; expected a folder, or a name for a new one")
    command = shlex.join(["experiments/figures/make.py", *words]) if words not in ([], ["--fast"]) else "make figures"
    try:
        figures(args.only, out, command + " FAST=1" * (words == ["--fast"]), fast=args.fast, fresh=args.fresh)
    except (OSError, Failed, BadInput) as error:
        print(f"figures: {error}", file=sys.stderr)
        return FAILED
    return DONE


def figures(names: list[str], out: Path, command: str, *, fast: bool, fresh: bool) -> dict[str, Caption]:
    """Each figure as soon as its runs are there; their captions."""
    begun = time.perf_counter()
    plan, there, told = wanted(fast=fast), set[str](), dict[str, Caption]()
    fly = functools.cache(flown)
    note = " (FAST: shorter runs and fewer seeds than those of `make figures`)" if fast else ""
    for name in names:
        sources = [Source(run, out / "runs" / run.name) for run in needed(name, plan)]
        for run, folder in sources:
            if run.name not in there:
                obtain(run, folder, fresh=fresh)
                there.add(run.name)
        figure, caption = drawn(name, sources, fly)
        told[name] = caption
        draw.save(figure, out / name)
        files.replace_text(out / f"{name}.md", captions.page(caption, Made(command, record.commit(), note, sources)))
        print(f"figures: {out / name}.png, .svg, .md: {caption.verdict}", flush=True)
    print(f"figures: done in {time.perf_counter() - begun:.0f} s", flush=True)
    return told


def needed(name: str, plan: list[Wanted]) -> list[Wanted]:
    """The runs of `plan` that the figure `name` is drawn from."""
    for beginning in FIGURES[name]:
        many = beginning.endswith("-")
        if found := [one for one in plan if one.name == beginning or (many and one.name.startswith(beginning))]:
            return found
    raise AssertionError(name)


def obtain(run: Wanted, folder: Path, *, fresh: bool) -> None:
    """See to it that the run is there and current."""
    if fresh:
        shutil.rmtree(folder, ignore_errors=True)
    if current(folder, run.config()):
        print(f"figures: {folder}: current", flush=True)
        return
    print(f"figures: qrl {' '.join(run.words)}", flush=True)
    print(f"figures: {folder}: made in {make(run, folder):.0f} s", flush=True)


def drawn(name: str, sources: list[Source], fly: "functools._lru_cache_wrapper[Flown]") -> tuple[Figure, Caption]:
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
    return Curves(label or f"median and quartiles of {len(returns)} seeds", steps, returns, success)


def rates(sources: list[Source]) -> list[Rate]:
    """Both methods' curves at each rate, the paper's first."""
    by_name = {source.run.name: source for source in sources}
    found = []
    for whose, before in (("the paper's learning rates", "paper-"), ("this recipe's learning rates", "")):
        for which in PAPER_RATES:
            name = f"pendulum-{before}{which}"
            if name in by_name:
                rate = by_name[name].run.flags["learning_rate"]
                ours = curves(by_name[name], f"ours, {rate:g}")
                ppo = curves(by_name[f"{name}-ppo"], f"PPO, {rate:g}")
                found.append(Rate(f"{whose}: {which}, {rate:g}", ours, ppo))
    return found


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")  # a GPU is the runs'
    run_to_the_end("figures", main)
