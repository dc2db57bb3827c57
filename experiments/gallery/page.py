"""The gallery's page as Markdown: what the runs found, and the pictures that there are."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.figures.captions import Caption
from experiments.figures.runs import Wanted

SHIPPED = ("pendulum", "hover", "circle")
ERRORS = "Errors over time: median and 5 to 95 % of 1,000 starts, beside the medians of the others."
SETTLE = "How long flights take to settle, by the tilt and speed that they began with."
PICTURES = {  # of a run -> what each shows
    "pendulum": {"learning_curve": "Return and success of the run's reports.", "evaluation": ERRORS},
    "hover": {"evaluation": ERRORS, "settle": SETTLE},
    "circle": {"flight": "Five flights of the last report.", "evaluation": ERRORS, "settle": SETTLE},
}
LEARNT = {
    "pendulum": "The paper's method to the end.",
    "hover": "The paper's method, and then the gradient of flights through the simulator.",
    "circle": "The paper's method, and then the gradient of flights through the simulator.",
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
NAMED = 5  # failures by their index


class Flies(NamedTuple):
    """A shipped preset's run, PPO's beside it, and what `qrl evaluate` found."""

    ours: Wanted
    ppo: Wanted
    folder: Path
    found: dict[str, Any]  # evaluation.json

    @property
    def task(self) -> str:
        return self.ours.task


class Made(NamedTuple):
    """How the gallery came to be."""

    command: str
    versions: dict[str, str]
    there: set[str]  # files in gallery/


def page(made: Made, captions: dict[str, Caption], flies: list[Flies], sections: Sequence[str]) -> str:
    """The gallery; `sections`: pages that other commands left, "" where they did not."""
    lines = [
        "# Gallery",
        "",
        f"Made by `{made.command}` with {', '.join(f'{name} {version}' for name, version in made.versions.items())}.",
        "",
        "## What the paper claims, and what was found",
        "",
        "| figure | the paper's claim | here |",
        "|---|---|---|",
        *(f"| [{told.title}](#{name}) | {told.claim} | **{told.verdict}** |" for name, told in captions.items()),
        "",
        "The figures' policies learn by the paper's method alone, without the analytic gradient that ends the shipped"
        " presets; but trajectories are turned by the tasks' symmetries, which the paper does not do.",
        "",
    ]
    for name, told in captions.items():
        lines += [f'<a id="{name}"></a>', "", f"### {told.title}", "", f"![{told.title}](gallery/{name}.png)", ""]
        lines += [told.shows, "", *told.found, "", f"**{told.verdict.capitalize()}.** {told.rule}"]
        lines += [f"([How it was made.](gallery/{name}.md))", ""]
    lines += ["## The policies that the presets train", ""]
    for one in flies:
        lines += policy(one, made.there)
    for text in filter(None, sections):
        lines += [demoted(text), ""]
    if "bench.png" in made.there:
        lines += ["![Ratios of the bench](gallery/bench.png)", ""]
    return "\n".join(lines)


def policy(one: Flies, there: set[str]) -> list[str]:
    """A task's policy: its numbers beside others', off nominal, its failures, and its pictures."""
    found = one.found
    (ppo,) = found["beside"].values()
    columns = {"policy": found, "PPO": ppo, **found.get("baselines", {})}
    rows = {key: row for key, row in ROWS.items() if key in found}
    lines = [f"### {one.task.capitalize()}", "", LEARNT[one.task]]
    lines += [f"`qrl {' '.join(one.ours.words)}`, {found['env_steps']:,} steps; PPO: `qrl {' '.join(one.ppo.words)}`,"]
    lines += [f"{ppo['env_steps']:,} steps. {found['starts']:,} fresh starts, deterministic policies.", ""]
    lines += ["| | " + " | ".join(columns) + " |", "|---" * (1 + len(columns)) + "|"]
    for key, (heading, factor, form) in rows.items():
        cells = [cell(key, pilot.get(key), factor, form) for pilot in columns.values()]
        lines.append(f"| {heading} | " + " | ".join(cells) + " |")
    if off := found.get("off_nominal"):
        shares = ", ".join(f"{name} {100 * result['success']:.1f} %" for name, result in off.items())
        lines += ["", f"Success of the policy off nominal (`--off-nominal`): {shares}."]
    lines += ["", failures(found)]
    for name, says in PICTURES[one.task].items():
        lines += ["", f"![{says}](gallery/{one.task}_{name}.png)", "", f"*{says}*"]
    if one.task == VIEWED and "view.png" in there:
        lines += ["", "![The viewer](gallery/view.png)", "", "*`make view`: flights in 3D, one HTML file.*"]
    return [*lines, ""]


def failures(found: dict[str, Any]) -> str:
    starts = [str(each["start"]) for each in found["failures"]]
    if not starts:
        return "No start fails."
    more = " …" if found["failed"] > NAMED else ""
    first = f"{' '.join(starts[:NAMED])}{more}"
    return f"{found['failed']:,} starts fail: {first}; `qrl view RUN --starts {starts[0]}` replays one."


def cell(key: str, value: float | None, factor: float, form: str) -> str:
    """evaluation.json has null for what is infinite or no number."""
    if value is None:
        return "never" if key.startswith("settle") else "–"
    return f"{factor * value:{form}}"


def demoted(text: str) -> str:
    """A page as a section of another."""
    return "\n".join(f"#{line}" if line.startswith("#") else line for line in text.rstrip().splitlines())
