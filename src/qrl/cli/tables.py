"""What `qrl evaluate` prints: a column for each pilot, or for each condition that one flew in."""

import math
from typing import Any

from qrl.cli.terminal import console
from qrl.evaluation.trained_run import STARTS

APART = ("seed", "starts", "failed")  # numbers that are no measure of a flight
NAMED = 10  # failures by their index


def table(columns: dict[str, dict[str, Any]]) -> None:
    """One column for each of `columns`, one row for each number that the first of them has."""
    first = next(iter(columns.values()))
    names = [name for name, x in first.items() if isinstance(x, int | float) and name not in APART]
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
    console.print(f"\nseed {result['seed']}, its last {len(columns)} checkpoints by environment steps")
    table({head: {k: v for k, v in one.items() if k != "env_steps"} for head, one in columns.items()})


def off_nominal(who: str, result: dict[str, Any]) -> None:
    console.print(f"\n{who}")
    nominal = {name: result[name] for name in next(iter(result["off_nominal"].values()))}
    table({"nominal": nominal, **result["off_nominal"]})


def failures(who: str, result: dict[str, Any]) -> None:
    """How many failed, and which of the starts those were."""
    listed = result["failures"]
    console.print(f"{who}: {result['failed']:,} of {result['starts']:,} starts failed", end="")
    if not listed:
        console.print()
        return
    first = " ".join(str(each["start"]) for each in listed[:NAMED])
    more = " …" if result["failed"] > NAMED else ""
    replay = f" (qrl view RUN --starts {first.split()[0]} replays one)" if listed[0]["start"] < STARTS else ""
    console.print(f": {first}{more}{replay}")


def _cell(name: str, one: dict[str, Any]) -> str:
    if name not in one:
        return ""
    value = one[name]
    if name == "env_steps":
        return f"{value:,}"
    return f"{value:.2f}" if name.startswith("return") else f"{value:.4f}"
