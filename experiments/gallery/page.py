"""The gallery's page as Markdown: results of the runs, and the pictures that exist."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from experiments.figures.captions import Caption
from experiments.figures.runs import RunSpec
from experiments.output import table

SHIPPED = ("pendulum", "hover", "circle")
ERRORS = "Errors over time: median and 5 to 95 % of 1,000 starts, beside the medians of the others."
SETTLE = "Settle time by initial tilt and speed."
PICTURES = {  # of a run -> what each shows
    "pendulum": {"learning_curve": "Return and success of the run's reports.", "evaluation": ERRORS},
    "hover": {"evaluation": ERRORS, "settle": SETTLE},
    "circle": {"flight": "Five flights of the last report.", "evaluation": ERRORS, "settle": SETTLE},
}
METHOD = {
    "pendulum": "Without APG (the paper's learner, with symmetries).",
    "hover": "The paper's learner, with symmetries, then APG.",
    "circle": "The paper's learner, with symmetries, then APG.",
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
NAMED = 5  # failures listed by index


class PresetResult(NamedTuple):
    """A shipped preset's run, PPO's beside it, and what `qrl evaluate` found."""

    ours: RunSpec
    ppo: RunSpec
    folder: Path
    found: dict[str, Any]  # evaluation.json

    @property
    def task(self) -> str:
        return self.ours.task


class Provenance(NamedTuple):
    """How the gallery was made."""

    command: str
    versions: dict[str, str]
    pictures: set[str]  # files in gallery/


def page(
    provenance: Provenance, captions: dict[str, Caption], results: list[PresetResult], sections: Sequence[str]
) -> str:
    """The gallery; `sections`: pages of other commands, "" where missing."""
    claims = [[f"[{one.title}](#{name})", one.claim, f"**{one.verdict}**"] for name, one in captions.items()]
    versions = ", ".join(f"{name} {version}" for name, version in provenance.versions.items())
    lines = [
        "# Gallery",
        "",
        f"Made by `{provenance.command}` with {versions}.",
        "",
        "## What the paper claims, and what was found",
        "",
        table(["figure", "the paper's claim", "here"], claims),
        "",
        "The figures' policies are trained without APG: the shipped presets of hover and circle end with APG. Those of"
        " hover and circle are augmented by the task's symmetries, which the paper's method is not; the pendulum's are"
        " not.",
        "",
    ]
    for name, caption in captions.items():
        lines += [f'<a id="{name}"></a>', "", f"### {caption.title}", "", f"![{caption.title}](gallery/{name}.png)", ""]
        lines += [caption.shows, "", *caption.found, "", f"**{caption.verdict.capitalize()}.** {caption.rule}"]
        lines += [f"([How it was made.](gallery/{name}.md))", ""]
    lines += ["## The policies that the presets train", ""]
    for one in results:
        lines += policy(one, provenance.pictures)
    for text in filter(None, sections):
        lines += [nest_headings(text), ""]
    if "bench.png" in provenance.pictures:
        lines += ["![Ratios of the bench](gallery/bench.png)", ""]
    return "\n".join(lines)


def policy(one: PresetResult, there: set[str]) -> list[str]:
    """A task's policy: its numbers beside others', off nominal, its failures, and its pictures."""
    found = one.found
    (ppo,) = found["beside"].values()
    columns = {"policy": found, "PPO": ppo, **found.get("baselines", {})}
    rows = {key: row for key, row in ROWS.items() if key in found}
    lines = [f"### {one.task.capitalize()}", "", METHOD[one.task]]
    lines += [f"`qrl {' '.join(one.ours.words)}`, {found['env_steps']:,} steps; PPO: `qrl {' '.join(one.ppo.words)}`,"]
    lines += [f"{ppo['env_steps']:,} steps. {found['starts']:,} fresh starts, deterministic policies.", ""]
    cells = [
        [heading, *(cell(key, column.get(key), factor, form) for column in columns.values())]
        for key, (heading, factor, form) in rows.items()
    ]
    lines.append(table(["", *columns], cells))
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
    """null in evaluation.json: infinite or not measured."""
    if value is None:
        return "never" if key.startswith("settle") else "–"
    return f"{factor * value:{form}}"


def nest_headings(text: str) -> str:
    """Lower each heading by one level."""
    return "\n".join(f"#{line}" if line.startswith("#") else line for line in text.rstrip().splitlines())
