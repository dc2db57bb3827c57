"""The gallery, docs/gallery.md and its pictures: `make gallery`, or `make gallery FAST=1`.

    .venv/bin/python -m experiments.gallery.make [--out docs] [--runs experiments/out] [--fast] [--fresh]

The paper's figures (as `make figures` makes them), the policies of the presets that ship (trained, flown by `qrl
evaluate` beside controllers and PPO, and shown by `qrl view`), and the pages of `make ablation` and `make bench` where
they exist. Runs of the same code are kept. The viewer's picture needs Chromium
and its driver; without them the old one stays.
"""

import json
import shutil
import sys
from pathlib import Path

import jax

from experiments.arguments import Parser, run_main
from experiments.figures import make as figures
from experiments.figures import runs as figure_runs
from experiments.figures.runs import Failed, RunSpec, is_current
from experiments.gallery import browser
from experiments.gallery import page as gallery_page
from experiments.gallery.page import PICTURES, SHIPPED, VIEWED, PresetResult, Provenance
from experiments.output import atomic_write
from qrl.cli.terminal import DONE, FAILED
from qrl.runs import files, record
from qrl_envs.specfile import BadInput

OUT, RUNS = Path("docs"), Path("experiments/out")


def main(argv: list[str] | None = None) -> int:
    parser = Parser("gallery", __doc__)
    parser.add_argument("--out", type=Path, default=OUT, help=f"({OUT})", metavar="FOLDER")
    parser.add_argument("--runs", type=Path, default=RUNS, help=f"({RUNS})", metavar="FOLDER")
    parser.add_argument("--fast", action="store_true", help="the figures from shorter runs of fewer seeds")
    parser.add_argument("--fresh", action="store_true", help="train all runs again")
    args = parser.parse_args(argv)
    for flag, folder in (("--out", args.out), ("--runs", args.runs)):
        parser.check_folder(flag, folder)
    try:
        gallery(args.out, args.runs, fast=args.fast, fresh=args.fresh)
    except (OSError, Failed, BadInput) as error:
        print(f"gallery: {error}", file=sys.stderr)
        return FAILED
    print(f"gallery: {args.out / 'gallery.md'}")
    return DONE


def gallery(out: Path, runs: Path, *, fast: bool, fresh: bool) -> None:
    """Train and evaluate what is missing or stale, then write the pictures and the page."""
    versions = record.versions()  # before committed pictures change
    drawn = runs / ("figures_fast" if fast else "figures")
    command = f"make figures{' FAST=1' * fast}"
    captions = figures.figures(list(figures.FIGURES), drawn, command, fast=fast, fresh=fresh)
    results = [evaluate_preset(task, runs / "gallery", fresh=fresh) for task in SHIPPED]
    pictures = out / "gallery"
    pictures.mkdir(parents=True, exist_ok=True)
    for name in captions:
        for form in ("png", "md"):
            copy(drawn / f"{name}.{form}", pictures / f"{name}.{form}")
    for one in results:
        for name in PICTURES[one.task]:
            copy(one.folder / f"{name}.png", pictures / f"{one.task}_{name}.png")
    bench = runs / "bench" / "bench.png"
    if bench.exists():
        copy(bench, pictures / "bench.png")
    else:
        (pictures / "bench.png").unlink(missing_ok=True)
    screenshot(runs / "gallery" / VIEWED / "view.html", "#start=1&t=3", pictures / "view.png")
    there = {path.name for path in pictures.iterdir()}
    sections = [read_if_exists(runs / "ablation.md"), read_if_exists(runs / "bench" / "bench.md")]
    page = gallery_page.page(
        Provenance(f"make gallery{' FAST=1' * fast}", versions, there), captions, results, sections
    )
    files.replace_text(out / "gallery.md", page)


def evaluate_preset(task: str, folder: Path, *, fresh: bool) -> PresetResult:
    """Train the shipped preset with a held-out seed and evaluate it beside the controllers and PPO."""
    ours, ppo = RunSpec(task, task, task, {}), RunSpec(f"{task}-ppo", task, f"{task}_ppo", {})
    for one in (ours, ppo):
        ensure_run(one, folder / one.name, fresh=fresh)
    run = folder / ours.name
    off = ["--off-nominal"] if task != "pendulum" else []
    figure_runs.qrl(["evaluate", str(run), *off, "--beside", str(folder / ppo.name)])
    if task == VIEWED:
        figure_runs.qrl(["view", str(run)])
    return PresetResult(ours, ppo, run, json.loads((run / "evaluation.json").read_text(encoding="utf-8")))


def ensure_run(one: RunSpec, folder: Path, *, fresh: bool) -> None:
    if not fresh and is_current(folder, one.config()):
        print(f"gallery: {folder}: current", flush=True)
        return
    if fresh:
        shutil.rmtree(folder, ignore_errors=True)
    print(f"gallery: qrl {' '.join(one.words)}", flush=True)
    print(f"gallery: {folder}: trained in {figure_runs.train(one, folder):.0f} s", flush=True)


def copy(source: Path, target: Path) -> None:
    atomic_write(target, lambda temporary: shutil.copyfile(source, temporary))


def screenshot(html: Path, address: str, target: Path) -> None:
    """Save the page as Chromium renders it; without Chromium, or if that fails, warn and keep `target`."""
    wrong = f"missing here: {', '.join(browser.missing())}" if browser.missing() else None
    if not wrong:
        with browser.chromium({}) as driver:
            wrong = browser.drawn(driver, f"{html.resolve().as_uri()}{address}")
            browser.wait_for(driver, browser.NEXT_FRAME)
            picture = driver.get_screenshot_as_png()
        if not wrong:
            atomic_write(target, lambda temporary: temporary.write_bytes(picture))
    if wrong:
        print(f"gallery: {target} kept: {wrong}", file=sys.stderr)


def read_if_exists(path: Path) -> str:
    """The text of a file, or ""."""
    return path.read_text(encoding="utf-8") if path.exists() else ""


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")  # a GPU is the runs'
    run_main("gallery", main)
