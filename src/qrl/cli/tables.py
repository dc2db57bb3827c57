"""Tables of `qrl evaluate`: one column per policy or controller, or per condition."""

import math
from typing import Any

from qrl.cli.terminal import console
from qrl.evaluation.starts import STARTS

NOT_MEASURES = ("seed", "starts", "failed", "flies")
LISTED = 10  # failed starts


def table(columns: dict[str, dict[str, Any]]) -> None:
    """One column per entry of `columns`, one row per number in the first of them."""
    first = next(iter(columns.values()))
    names = [name for name, x in first.items() if isinstance(x, int | float) and name not in NOT_MEASURES]
    names = [name for name in names if not math.isnan(first[name])]
    widths = [max(11, len(head)) for head in columns]
    corner = max(len(name) for name in names)
    heads = (f"{head:>{width}}" for head, width in zip(columns, widths, strict=True))
    console.print(" ".join([f"{'':<{corner}}", *heads]))
    for name in names:
        cells = (f"{_cell(name, one):>{width}}" for one, width in zip(columns.values(), widths, strict=True))
        console.print(" ".join([f"{name:<{corner}}", *cells]))


def checkpoints(result: dict[str, Any]) -> None:
    columns = {f"{one['env_steps']:,}": one for one in result["checkpoints"]}
    console.print(f"\nseed {result['seed']}, last {len(columns)} checkpoints by environment steps")
    table({head: {k: v for k, v in one.items() if k != "env_steps"} for head, one in columns.items()})
    console.print()


def off_nominal(title: str, result: dict[str, Any]) -> None:
    """One row per condition, one column per number."""
    console.print(f"\n{title}")
    rows = {"nominal": {name: result[name] for name in next(iter(result["off_nominal"].values()))}}
    rows |= result["off_nominal"]
    names = [name for name, x in rows["nominal"].items() if not math.isnan(x)]
    corner = max(map(len, rows))
    console.print(" ".join([f"{'':<{corner}}", *names]))
    for condition, one in rows.items():
        console.print(" ".join([f"{condition:<{corner}}", *(f"{_cell(name, one):>{len(name)}}" for name in names)]))


def failures(name: str, result: dict[str, Any]) -> None:
    listed = result["failures"]
    console.print(f"{name}: {result['failed']:,} of {result['starts']:,} starts failed", end="")
    if not listed:
        console.print()
        return
    first = " ".join(str(each["start"]) for each in listed[:LISTED])
    more = " …" if result["failed"] > LISTED else ""
    replay = f" (qrl view RUN --starts {first.split()[0]} replays one)" if listed[0]["start"] < STARTS else ""
    console.print(f": {first}{more}{replay}")


def _cell(name: str, one: dict[str, Any]) -> str:
    if name not in one:
        return ""
    value = one[name]
    if name == "env_steps":
        return f"{value:,}"
    if name.startswith("return"):
        return f"{value:.2f}"
    return f"{value:.1e}" if 0.0 < abs(value) < 5e-4 else f"{value:.4f}"  # an error of 0.1 mm is not 0
