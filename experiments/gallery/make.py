"""The gallery, docs/gallery.md and its pictures: `make gallery`, or `make gallery FAST=1`.

    .venv/bin/python -m experiments.gallery.make [--out docs] [--runs experiments/out] [--fast] [--fresh]

The paper's figures (as `make figures` makes them), the policies of the presets that ship (trained, flown by `qrl
evaluate` beside controllers and PPO, and shown by `qrl view`), and what `make ablation` and `make bench` left, where
they did. Runs are kept while they are current. The viewer's picture needs Chromium and its driver; without them the old
one stays.
"""

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import jax

from experiments.arguments import Parser, run_to_the_end
from experiments.figures import make as figures
from experiments.figures import runs as figure_runs
from experiments.figures.runs import Failed, Wanted, current
from experiments.gallery import browser
from experiments.gallery import page as gallery_page
from experiments.gallery.page import PICTURES, SHIPPED, VIEWED, Flies, Made
from qrl.cli.terminal import DONE, FAILED
from qrl.runs import files, record
from qrl_envs.specfile import BadInput

OUT, RUNS = Path("docs"), Path("experiments/out")


def main(argv: list[str] | None = None) -> int:
    parser = Parser("gallery", __doc__)
    parser.add_argument("--out", type=Path, default=OUT, help=f"({OUT})", metavar="FOLDER")
    parser.add_argument("--runs", type=Path, default=RUNS, help=f"({RUNS})", metavar="FOLDER")
    parser.add_argument("--fast", action="store_true", help="the figures from shorter runs of fewer seeds")
    parser.add_argument("--fresh", action="store_true", help="make the runs again")
    args = parser.parse_args(argv)
    for flag, folder in (("--out", args.out), ("--runs", args.runs)):
        if folder.exists() and not folder.is_dir():
            parser.error(f"{flag}: {folder} is a file; expected a folder, or a name for a new one")
    try:
        gallery(args.out, args.runs, fast=args.fast, fresh=args.fresh)
    except (OSError, Failed, BadInput) as error:
        print(f"gallery: {error}", file=sys.stderr)
        return FAILED
    print(f"gallery: {args.out / 'gallery.md'}")
    return DONE


def gallery(out: Path, made: Path, *, fast: bool, fresh: bool) -> None:
    """Make what is not there or not current, then the pictures and the page."""
    versions = record.versions()  # before the pictures that are committed change
    drawn = made / ("figures_fast" if fast else "figures")
    command = f"make figures{' FAST=1' * fast}"
    captions = figures.figures(list(figures.FIGURES), drawn, command, fast=fast, fresh=fresh)
    flies = [flown(task, made / "gallery", fresh=fresh) for task in SHIPPED]
    pictures = out / "gallery"
    pictures.mkdir(parents=True, exist_ok=True)
    for name in captions:
        for form in ("png", "md"):
            copy(drawn / f"{name}.{form}", pictures / f"{name}.{form}")
    for one in flies:
        for name in PICTURES[one.task]:
            copy(one.folder / f"{name}.png", pictures / f"{one.task}_{name}.png")
    bench = made / "bench" / "bench.png"
    if bench.exists():
        copy(bench, pictures / "bench.png")
    else:
        (pictures / "bench.png").unlink(missing_ok=True)
    photograph(made / "gallery" / VIEWED / "view.html", "#start=1&t=3", pictures / "view.png")
    there = {path.name for path in pictures.iterdir()}
    sections = [left(made / "ablation.md"), left(made / "bench" / "bench.md")]
    page = gallery_page.page(Made(f"make gallery{' FAST=1' * fast}", versions, there), captions, flies, sections)
    files.replace_text(out / "gallery.md", page)


def flown(task: str, folder: Path, *, fresh: bool) -> Flies:
    """The shipped preset's run, seed 0, flown beside controllers and PPO; one of them shown."""
    ours, ppo = Wanted(task, task, task, {}), Wanted(f"{task}-ppo", task, f"{task}_ppo", {})
    for one in (ours, ppo):
        made(one, folder / one.name, fresh=fresh)
    mine = folder / ours.name
    off = ["--off-nominal"] if task != "pendulum" else []
    figure_runs.qrl(["evaluate", str(mine), *off, "--beside", str(folder / ppo.name)])
    if task == VIEWED:
        figure_runs.qrl(["view", str(mine)])
    return Flies(ours, ppo, mine, json.loads((mine / "evaluation.json").read_text(encoding="utf-8")))


def made(one: Wanted, folder: Path, *, fresh: bool) -> None:
    if not fresh and current(folder, one.config()):
        print(f"gallery: {folder}: current", flush=True)
        return
    if fresh:
        shutil.rmtree(folder, ignore_errors=True)
    print(f"gallery: qrl {' '.join(one.words)}", flush=True)
    print(f"gallery: {folder}: made in {figure_runs.make(one, folder):.0f} s", flush=True)


def copy(source: Path, target: Path) -> None:
    whole(target, lambda temporary: shutil.copyfile(source, temporary))


def whole(target: Path, write: Callable[[Path], object]) -> None:
    """The file whole or not at all."""
    temporary = target.with_name(f"{target.name}.tmp")
    write(temporary)
    temporary.replace(target)


def photograph(html: Path, address: str, target: Path) -> None:
    """The page at `address` as Chromium draws it; where there is none or it fails, a warning, and `target` stays."""
    wrong = f"missing here: {', '.join(browser.missing())}" if browser.missing() else None
    if not wrong:
        with browser.chromium({}) as driver:
            wrong = browser.drawn(driver, f"{html.resolve().as_uri()}{address}")
            browser.wait_for(driver, browser.NEXT_FRAME)
            picture = driver.get_screenshot_as_png()
        if not wrong:
            whole(target, lambda temporary: temporary.write_bytes(picture))
    if wrong:
        print(f"gallery: {target} stays as it is: {wrong}", file=sys.stderr)


def left(path: Path) -> str:
    """A page that another command left, or nothing."""
    return path.read_text(encoding="utf-8") if path.exists() else ""


if __name__ == "__main__":
    jax.config.update("jax_platforms", "cpu")  # a GPU is the runs'
    run_to_the_end("gallery", main)
