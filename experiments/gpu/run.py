"""Measures qrl on a GPU: `make gpu`, or `python -m experiments.gpu.run`; without one exit code 2, or --any-device.

Sections in processes of their own, those of the bars first; each is given its share of the time that is left
(--budget-seconds). Writes OUT/gpu.json, anew with every figure, and at the end OUT/gpu.md, which it also prints:

plant      steps/s of the plant alone: of a Crazyflie (lag, drag, sensors, uncertainty), and the paper's ideal one
acting     steps/s of rollouts: policy, noise, plant, reward, fresh starts, recording; recurrent on the real plant
hover any circle track   seconds to compile and to train TASK with the preset TASK_gpu, and success
seeds      the same of many seeds of hover in one program, by vmap
learner    samples/s of the paper's learner by minibatch; apg: steps/s of the analytic policy gradient by flights
profile    what the device does in two unrolls with their updates, and in an APG update: its longest operations
training   environment steps/s of the training loop at Brax PPO's sample reuse and unroll length
brax       Brax's acting and training loop; crazyflow: its physics, in an environment that is installed first
"""

import argparse
import json
import math
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, NamedTuple

from experiments.arguments import Parser, run_main
from experiments.bench.install import NotInstalled, python_of
from experiments.bench.process import follow
from experiments.bench.tables import number
from experiments.output import table
from qrl.runs import files, record

ROOT = Path(__file__).resolve().parents[2]
BASELINES = ROOT / "experiments" / "baselines"
MARK = "BENCH "  # prefix of a result line
LEAST_SECONDS = 5.0  # that a section is begun with
INSTALL_SECONDS = 300.0
NOT_REACHED = "not reached"
DEVICES = (
    "import json, jax; print(json.dumps([{'platform': d.platform, 'kind': d.device_kind,"
    " 'memory_bytes': (d.memory_stats() or {}).get('bytes_limit')} for d in jax.devices()]))"
)

Row = dict[str, Any]


class Section(NamedTuple):
    name: str
    weight: float  # its share of the time is this, over the weights of those that are left
    script: str | None = None  # of another library; None: `experiments.gpu.sections`
    environment: str | None = None  # of that script; None: this one


SECTIONS = (
    Section("plant", 40),
    Section("acting", 70),
    Section("hover", 70),
    Section("any", 110),
    Section("seeds", 70),
    Section("learner", 30),
    Section("apg", 40),
    Section("circle", 40),
    Section("track", 50),
    Section("profile", 40),
    Section("training", 20),
    Section("brax", 40, script="brax_speed.py"),
    Section("crazyflow", 20, script="crazyflow_physics.py", environment="crazyflow"),
)
SIZES = {
    "lanes": (tuple(1024 * 4**i for i in range(6)), "environments that are stepped in parallel"),
    "minibatches": (tuple(1600 * 10**i for i in range(4)), "samples of a minibatch of the learner"),
    "flights": (tuple(64 * 4**i for i in range(5)), "flights of an update of APG"),
    "seeds": ((1, 16, 128), "seeds of hover that are trained in one program"),
    "training_lanes": ((512, 8192), "environments of the training loop, multiples of 128"),
}
CALL_STEPS = 2**21
MOST_PEER_LANES = 2**18  # with more, what Brax records of 50 steps may not fit a device


class Bar(NamedTuple):
    """What one H100 should do: the best rate, or the seconds of training after which all fly."""

    text: str
    section: str
    prefix: str  # of the figures
    least_per_second: float | None = None
    most_seconds: float | None = None


BARS = (
    Bar("acting on the real plant, steps/s", "acting", "acting, real", least_per_second=300e6),
    Bar("the real plant alone, steps/s", "plant", "plant, real", least_per_second=1e9),
    Bar("hover, training [s]", "hover", "hover_gpu, 1 seed", most_seconds=1.0),
    Bar("any vehicle, training [s]", "any", "any_gpu, 1 seed", most_seconds=60.0),
    Bar("128 seeds of hover, training [s]", "seeds", "hover_gpu, 128 seeds", most_seconds=10.0),
)


def main(argv: list[str] | None = None) -> int:
    names = [section.name for section in SECTIONS]
    parser = Parser("gpu", __doc__)
    parser.add_argument("--out", type=Path, default=Path("experiments/out/gpu"), metavar="FOLDER")
    parser.add_argument("--environments", type=Path, default=Path("experiments/out/baselines"), metavar="FOLDER")
    parser.add_argument("--budget-seconds", type=float, default=480.0, help="limit without installing", metavar="S")
    parser.add_argument("--only", nargs="+", choices=names, default=names, help="of the sections above", metavar="NAME")
    parser.add_argument("--any-device", action="store_true", help="measure what JAX has, if it is no GPU")
    add_sizes(parser)
    args = parser.parse_args(argv)
    if not args.budget_seconds > 0:
        parser.error("expected --budget-seconds above 0")
    if any(value < 1 for name in SIZES for value in getattr(args, name)) or args.call_steps < 1:
        parser.error("expected sizes of at least 1")
    parser.check_folder("--out", args.out)
    try:
        devices = find_devices()
    except RuntimeError as error:
        parser.error(str(error))
    if devices[0]["platform"] != "gpu" and not args.any_device:
        parser.error(
            f"expected a GPU, and JAX has {describe(devices)}; --any-device measures that,"
            " pip install -e '.[cuda]' gives JAX for CUDA"
        )
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        measure([section for section in SECTIONS if section.name in args.only], args, devices)
    except OSError as error:
        print(f"gpu: {error}", file=sys.stderr)
        return 1
    return 0


def add_sizes(parser: argparse.ArgumentParser) -> None:
    for name, (default, text) in SIZES.items():
        flag = f"--{name.replace('_', '-')}"
        parser.add_argument(flag, type=int, nargs="+", default=default, metavar="N", help=text)
    hides = "environment steps of a timed call, which hide what a call costs"
    parser.add_argument("--call-steps", type=int, default=CALL_STEPS, metavar="N", help=hides)


def find_devices() -> list[dict[str, Any]]:
    """JAX's devices, asked for by another process: this one would keep the memory of a GPU. RuntimeError if none."""
    words = [sys.executable, "-c", DEVICES]
    done = subprocess.run(words, capture_output=True, text=True, env=environment(None))
    if done.returncode:
        raise RuntimeError(f"JAX finds no device: {last_line(done.stderr)}")
    return json.loads(done.stdout.splitlines()[-1])


def describe(devices: list[dict[str, Any]]) -> str:
    """Such as "8 × cpu" or "1 × NVIDIA H100 80GB HBM3"."""
    kinds = [device["kind"] for device in devices]
    return ", ".join(f"{kinds.count(kind)} × {kind}" for kind in dict.fromkeys(kinds))


class Report:
    """The rows so far, in OUT/gpu.json from the first one on."""

    def __init__(self, out: Path, about: dict[str, Any]) -> None:
        self.out = out
        self.about = about
        self.rows: list[Row] = []

    def add(self, section: str, row: Row) -> None:
        self.rows.append({"section": section, **row})
        files.write_json(self.out / "gpu.json", {**self.about, "rows": self.rows})
        print(f"{section}: {row['figure']}: {found(row)}", flush=True)

    def write_page(self) -> str:
        """Write gpu.md; its text."""
        text = page(self.about, self.rows)
        files.replace_text(self.out / "gpu.md", text)
        return text


def measure(sections: list[Section], args: argparse.Namespace, devices: list[dict[str, Any]]) -> None:
    """All sections within the budget; the page is written whatever happens."""
    about = {
        "devices": describe(devices),
        "memory_bytes": devices[0]["memory_bytes"],
        "versions": record.versions(),
        "budget_seconds": args.budget_seconds,
    }
    report = Report(args.out, about)
    on_gpu = devices[0]["platform"] == "gpu"
    pythons = {section.name: interpreter(section, args.environments, on_gpu) for section in sections}
    begun = time.monotonic()
    try:
        for i, section in enumerate(sections):
            left = args.budget_seconds - (time.monotonic() - begun)
            seconds = share(left, [other.weight for other in sections[i:]])
            if isinstance(python := pythons[section.name], NotInstalled):
                report.add(section.name, {"figure": section.name, "failed": f"not installed: {python}"})
            elif seconds < LEAST_SECONDS:
                report.add(section.name, {"figure": section.name, "failed": NOT_REACHED})
            else:
                run_section(section, command(section, python, args, on_gpu), seconds, report)
    finally:
        print("\n" + report.write_page() + f"\n{args.out}/gpu.json, gpu.md")


def share(left: float, weights: list[float]) -> float:
    """Seconds for the first of the sections with these weights, so that there are some for each; what a section leaves
    over is the others'.
    """
    return max(0.0, left) * weights[0] / sum(weights)


def run_section(section: Section, words: list[str], seconds: float, report: Report) -> None:
    """The rows of a section as they come, and one more if it fails or is out of time."""
    words = [*words, "--until", str(time.time() + seconds - 1.0)] if section.script is None else words

    def each(line: str) -> None:
        if line.startswith(MARK):
            report.add(section.name, json.loads(line.removeprefix(MARK)))

    errors, ended = follow(words, environment(report.out / "cache"), seconds, each)
    if ended != "done":
        why = f": {last_line(errors)}" if ended.startswith("exit") else f" after {seconds:.0f} s"
        report.add(section.name, {"figure": section.name, "failed": ended + why})


def last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no message"])[-1][:300]


def interpreter(section: Section, folder: Path, on_gpu: bool) -> Path | NotInstalled:
    """The Python of a section's environment, installed if it is missing: no part of the budget."""
    if section.environment is None:
        return Path(sys.executable)
    name = f"{section.environment}_cuda" if on_gpu else section.environment
    print(f"environment {name}", flush=True)
    try:
        return python_of(BASELINES / f"{name}.txt", (folder / name).absolute(), INSTALL_SECONDS)
    except NotInstalled as error:
        return error


def command(section: Section, python: Path, args: argparse.Namespace, on_gpu: bool) -> list[str]:
    """The words of a section's process."""

    def flag(name: str, most: float = math.inf) -> list[str]:
        return [f"--{name.replace('_', '-')}", *(str(n) for n in getattr(args, name) if n <= most)]

    if section.script is None:
        own = [word for name in SIZES for word in flag(name)] + ["--call-steps", str(args.call_steps)]
        return [str(python), "-m", "experiments.gpu.sections", section.name, *own]
    words = [str(python), str(BASELINES / section.script), *flag("lanes", MOST_PEER_LANES)]
    if section.name == "brax":
        return words + flag("training_lanes")
    return [*words[:2], "first_principles", *words[2:], "--device", "gpu" if on_gpu else "cpu"]


def environment(cache: Path | None) -> dict[str, str]:
    """Of a process that measures; compiled programs are kept in `cache`."""
    path = os.pathsep.join(str(ROOT / part) for part in ("src", "envs", "."))
    kept = {"JAX_COMPILATION_CACHE_DIR": str(cache.absolute())} if cache else {}
    return os.environ | {"PYTHONPATH": path, "TF_CPP_MIN_LOG_LEVEL": "2"} | kept


def quantity(value: float) -> str:
    """Three digits, billions as G."""
    return f"{value / 1e9:.3g}G" if abs(value) >= 1e9 else number(value)


# -- the page ------------------------------------------------------------------------------------------------


def found(row: Row) -> str:
    """What a row says, in a cell."""
    if "failed" in row:
        return str(row["failed"])
    if "per_second" in row:
        return f"{quantity(row['per_second'])}/s"
    if "success_mean" in row:
        words = [
            f"{row['seconds']:.2f} s of training",
            f"{row['compile_seconds']:.1f} s of compiling{', some of it from the cache' if row['cache_hits'] else ''}",
            f"{row['fly']} fly (99 % of {row['starts']} starts), success {row['success_mean']:.1%}",
        ]
        if row["last_flies_at_seconds"] is not None:
            words.append(f"by the reports after {row['last_flies_at_seconds']:.2f} s")
        if row["done"] < 1:
            words.append(f"stopped at {row['done']:.0%} of the steps")
        return "; ".join([*words, *row["faults"]])
    if "busy" in row:
        return f"{row['seconds'] * 1e3:.1f} ms, device busy {row['busy']:.0%}, {row['launches']:,} launches"
    return f"{number(row['seconds'])} s"


def page(about: dict[str, Any], rows: list[Row]) -> str:
    """gpu.md: bars, figures, and the longest operations."""
    versions = "; ".join(f"{name} {value}" for name, value in about["versions"].items())
    parts = [
        f"# qrl on {about['devices']}",
        f"{versions}.",
        table(
            ["bar, for one H100", "wanted", "found"],
            [[bar.text, wanted(bar), against(bar, rows)] for bar in BARS],
        ),
        table(["section", "figure", "found"], [[row["section"], row["figure"], found(row)] for row in rows]),
    ]
    for row in rows:
        if operations := row.get("operations"):
            lines = [
                [o["name"], o["origin"], f"{o['seconds'] * 1e3:.2f}", f"{o['share']:.1%}", f"{o['times']:,}"]
                for o in operations
            ]
            parts += [f"## {row['figure']}", table(["operation", "in JAX", "ms", "share", "times"], lines)]
    return "\n\n".join(parts) + "\n"


def wanted(bar: Bar) -> str:
    return f"≥ {quantity(bar.least_per_second)}" if bar.least_per_second else f"≤ {number(bar.most_seconds or 0.0)}"


def against(bar: Bar, rows: list[Row]) -> str:
    """The best that was found for a bar; a dash where it was not measured, "not" where one does not fly."""
    own = [row for row in rows if row["section"] == bar.section and row["figure"].startswith(bar.prefix)]
    if bar.least_per_second:
        rates = [row["per_second"] for row in own if row.get("per_second")]
        return quantity(max(rates)) if rates else "–"
    trained = [row for row in own if "success_mean" in row]
    if not trained:
        return "–"
    row = trained[-1]
    seconds, all_fly = number(row["seconds"]), row["success_min"] >= 0.99
    return seconds if all_fly else f"not: success {row['success_mean']:.1%} after {seconds}"


if __name__ == "__main__":
    run_main("gpu", main)
