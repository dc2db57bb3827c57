"""The gallery, docs/gallery.md and its pictures: `make gallery`.

    .venv/bin/python experiments/gallery.py [--out docs] [--runs experiments/out] [--fast]

The paper's figures (as `make figures` makes them), the policies of the presets that ship (trained, flown by `qrl
evaluate` and shown by `qrl view`), and what `make ablation` and `make bench` left, where they did. Runs are kept while
they are current. The page's picture needs Chromium; without it the one that is there stays.
"""

import json
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import jax

import figure_runs
import figures
from arguments import Parser
from figure_captions import Caption
from figure_runs import Failed, Wanted, current
from qrl import runs
from qrl.exits import DONE, FAILED, WRONG_INPUT
from qrl_envs.specfile import BadInput

RUNS = Path("experiments/out")
SHIPPED = ("pendulum", "hover", "circle")
PICTURES = {  # of the gallery's folder -> of a run's, and what it shows
    "pendulum": {"learning_curve": "The run's learning curve."},
    "hover": {
        "evaluation": "Errors over time: median and 5 to 95 % of 1,000 starts, beside the two controllers'.",
        "settle": "How long flights take to settle, by the tilt and speed that they began with.",
    },
    "circle": {
        "flight": "Five flights of the last report.",
        "evaluation": "Errors over time: median and 5 to 95 % of 1,000 starts, beside the two controllers'.",
        "settle": "How long flights take to settle, by the tilt and speed that they began with.",
    },
}
ROWS = {  # of evaluation.json -> heading, factor, form
    "return_mean": ("return", 1.0, ".1f"),
    "success": ("success, %", 100.0, ".1f"),
    "settle_median_s": ("settle, median, s", 1.0, ".2f"),
    "settle_p95_s": ("settle, p95, s", 1.0, ".2f"),
    "rms_position_m": ("steady state, mm", 1e3, ".1f"),
    "rms_radius_m": ("radius, mm", 1e3, ".1f"),
    "rms_height_m": ("height, mm", 1e3, ".1f"),
    "rms_speed_m_s": ("speed, m/s", 1.0, ".4f"),
    "rms_angle_rad": ("angle, rad", 1.0, ".4f"),
}
VIEWED = "circle"
CHROMIUMS = ("chromium", "chromium-browser", "google-chrome")
DRAWN_SECONDS = 300  # by a processor, if need be


class Flies(NamedTuple):
    """A shipped preset's run: its command, its steps, and what `qrl evaluate` found of it."""

    run: Wanted
    folder: Path
    found: dict[str, Any]


def main(argv: list[str] | None = None) -> int:
    parser = Parser("gallery", __doc__)
    parser.add_argument("--out", type=Path, default=Path("docs"), help="(docs)", metavar="FOLDER")
    parser.add_argument(
        "--runs", type=Path, default=Path("experiments/out"), help="(experiments/out)", metavar="FOLDER"
    )
    parser.add_argument("--fast", action="store_true", help="the figures from shorter runs of fewer seeds")
    args = parser.parse_args(argv)
    for flag, folder in (("--out", args.out), ("--runs", args.runs)):
        if folder.exists() and not folder.is_dir():
            parser.error(f"{flag}: {folder} is a file; expected a folder, or a name for a new one")
    try:
        gallery(args.out, args.runs, fast=args.fast)
    except (OSError, Failed, BadInput) as error:
        print(f"gallery: {error}", file=sys.stderr)
        return WRONG_INPUT if isinstance(error, BadInput) else FAILED
    print(f"gallery: {args.out / 'gallery.md'}")
    return DONE


def gallery(out: Path, made: Path, *, fast: bool) -> None:
    """Make what is not there or not current, then the page and its pictures."""
    drawn = made / ("figures_fast" if fast else "figures")
    command = "make figures FAST=1" if fast else "make figures"
    captions = figures.figures(list(figures.FIGURES), drawn, command, fast=fast, fresh=False)
    flies = [shipped(task, made / "gallery" / task) for task in SHIPPED]
    pictures = out / "gallery"
    pictures.mkdir(parents=True, exist_ok=True)
    for name in captions:
        copy(drawn / f"{name}.png", pictures / f"{name}.png")
    for task, one in zip(SHIPPED, flies, strict=True):
        for name in PICTURES[task]:
            copy(one.folder / f"{name}.png", pictures / f"{task}_{name}.png")
        if task == VIEWED:
            picture(one.folder / "view.html", "#start=1&t=3", pictures / "view.png")
    if (made / "bench" / "bench.png").exists():
        copy(made / "bench" / "bench.png", pictures / "bench.png")
    runs.replace_text(out / "gallery.md", page(captions, flies, left(made, "ablation"), left(made / "bench", "bench")))


def shipped(task: str, folder: Path) -> Flies:
    """The preset's run, seed 0, flown and shown."""
    run = Wanted(task, task, task, {})
    if current(folder, run.config()):
        print(f"gallery: {folder}: current", flush=True)
    else:
        print(f"gallery: {folder}: made in {figure_runs.make(run, folder):.0f} s", flush=True)
    figure_runs.qrl(["evaluate", str(folder), *(["--off-nominal"] if task != "pendulum" else [])])
    if task == VIEWED:
        figure_runs.qrl(["view", str(folder)])
    return Flies(run, folder, json.loads((folder / "evaluation.json").read_text(encoding="utf-8")))


def copy(source: Path, target: Path) -> None:
    """Whole or not at all."""
    temporary = target.with_name(f"{target.name}.tmp")
    shutil.copyfile(source, temporary)
    temporary.replace(target)


def picture(html: Path, address: str, target: Path) -> None:
    """A photograph of the page at `address`, as headless Chromium draws it; Failed where it does not."""
    browser = next(filter(None, map(shutil.which, CHROMIUMS)), None)
    if not browser:
        print(f"gallery: no Chromium: {target} stays as it is", file=sys.stderr)
        return
    flags = ["headless=new", "no-sandbox", "use-angle=swiftshader", "enable-unsafe-swiftshader", "hide-scrollbars"]
    flags += ["disable-dev-shm-usage", "window-size=1280,800", "virtual-time-budget=30000"]
    with tempfile.TemporaryDirectory() as there:
        taken = Path(there) / "view.png"
        words = [
            browser,
            *(f"--{flag}" for flag in flags),
            f"--screenshot={taken}",
            f"{html.resolve().as_uri()}{address}",
        ]
        done = subprocess.run(words, capture_output=True, text=True, timeout=DRAWN_SECONDS, check=False)
        if done.returncode or not taken.exists():
            raise Failed(f"{browser} took no picture of {html}: {' '.join(done.stderr.split())[-200:]}")
        copy(taken, target)


def left(folder: Path, name: str) -> str:
    """A page that another command left, or nothing."""
    path = folder / f"{name}.md"
    return path.read_text(encoding="utf-8") if path.exists() else ""


# The page


def page(captions: dict[str, Caption], flies: list[Flies], ablation: str, bench: str) -> str:
    """The gallery as Markdown; pictures lie in gallery/ beside it."""
    lines = [
        "# Gallery",
        "",
        "Made by `make gallery`: pictures and numbers of this page are of the runs that it names, on two CPU cores.",
        "",
        "## What the paper claims, and what was found",
        "",
        "| figure | the paper's claim | here |",
        "|---|---|---|",
        *(f"| [{told.title}](#{name}) | {told.claim} | **{told.verdict}** |" for name, told in captions.items()),
        "",
        "The figures' policies are trained by the paper's method alone (`--apg-fraction 0`).",
        "",
    ]
    for name, told in captions.items():
        lines += [f'<a id="{name}"></a>', "", f"### {told.title}", "", f"![{told.title}](gallery/{name}.png)", ""]
        lines += [told.shows, "", *told.found, "", f"**{told.verdict.capitalize()}.** {told.rule}", ""]
    lines += ["## The policies that the presets train", ""]
    lines += ["The paper's method and then the gradient of flights through the simulator; seed 0.", ""]
    for one in flies:
        lines += policy(one)
    for text in (ablation, bench):
        lines += [demoted(text), ""] if text else []
    lines += ["![Ratios to qrl](gallery/bench.png)", ""] if bench else []
    lines += [f"Versions: {', '.join(f'{name} {version}' for name, version in runs.versions().items())}.", ""]
    return "\n".join(lines)


def policy(one: Flies) -> list[str]:
    """A task's policy: its numbers beside the controllers', off nominal, and its pictures."""
    columns = {"policy": one.found, **one.found.get("baselines", {})}
    rows = {key: row for key, row in ROWS.items() if key in one.found}
    lines = [
        f"### {one.run.task.capitalize()}",
        "",
        f"`qrl {' '.join(one.run.words)}`, {one.found['env_steps']:,} steps;",
    ]
    lines += [f"{one.found['starts']:,} fresh starts, deterministic policy.", ""]
    lines += ["| | " + " | ".join(columns) + " |", "|---" * (1 + len(columns)) + "|"]
    for key, (heading, factor, form) in rows.items():
        cells = [f"{factor * found[key]:{form}}".replace("inf", "never") for found in columns.values()]
        lines.append(f"| {heading} | " + " | ".join(cells) + " |")
    if off := one.found.get("off_nominal"):
        shares = ", ".join(f"{name} {100 * there['success']:.1f} %" for name, there in off.items())
        lines += ["", f"Success off nominal (README, Train): {shares}."]
    for name, says in PICTURES[one.run.task].items():
        lines += ["", f"![{says}](gallery/{one.run.task}_{name}.png)", "", f"*{says}*"]
    if one.run.task == VIEWED:
        lines += ["", "![The page](gallery/view.png)", "", "*`make view`: flights in 3D, one HTML file.*"]
    return [*lines, ""]


def demoted(text: str) -> str:
    """A page as a section of another."""
    return "\n".join(f"#{line}" if line.startswith("#") else line for line in text.rstrip().splitlines())


def stop(*_: object) -> NoReturn:
    raise KeyboardInterrupt


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, stop)  # or the run at work would go on alone
    jax.config.update("jax_platforms", "cpu")  # a GPU is the runs'
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        print("gallery: interrupted; the same command goes on", file=sys.stderr)
        sys.exit(1)
