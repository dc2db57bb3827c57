"""A run that is killed at any moment, again and again, ends as one never stopped: bit for bit, clocks aside."""

import random
import time
from pathlib import Path

import pytest

import fault_injection
from fault_injection import LONG, LONG_STEPS, STEPS, STRESS, TRAIN

SAMPLE = [pytest.param("one", 3, {}, TRAIN, id="3 kills")]
ALL = [
    pytest.param("long", 40, {}, LONG, id="40 kills"),
    pytest.param("one", 40, {}, TRAIN, id="40 kills of short runs"),
    pytest.param("seeds", 24, {}, [*TRAIN, "--seeds", "2"], id="24 kills of two seeds"),
    pytest.param("devices", 24, {"JAX_NUM_CPU_DEVICES": "2"}, TRAIN, id="24 kills on two devices"),
]


@pytest.mark.parametrize(("name", "kills", "variables", "words"), ALL if STRESS else SAMPLE)
def test_killed_run_equals_one_never_stopped(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    kills: int,
    variables: dict[str, str],
    words: list[str],
) -> None:
    """By SIGTERM, SIGINT and SIGKILL in turn, while it loads, compiles, trains, saves and draws."""
    if name == "one":
        whole = fault_injection.whole_run(tmp_path_factory)
    else:
        whole = tmp_path / "whole"
        fault_injection.done(fault_injection.qrl(*words, "--out", whole, **variables))
    begun = time.monotonic()
    if STRESS:  # how long one takes whose programs are compiled
        fault_injection.done(fault_injection.qrl(*words, "--out", tmp_path / "again", **variables))
    seconds = max(time.monotonic() - begun, 8.0)
    seeds = ("seed-0", "seed-1") if "--seeds" in words else (".",)
    happened, again, most = 0, 0, 0
    while happened < kills:  # a run that ended too early counts as far as it went
        again += 1
        killed = tmp_path / f"killed-{again}"
        draw = random.Random(f"{name} {again}")
        once = fault_injection.killed_again_and_again(
            [*words, "--out", killed, "--resume"],
            [killed / seed for seed in seeds],
            kills - happened,
            draw,
            seconds,
            LONG_STEPS if words is LONG else STEPS,
            **variables,
        )
        happened, most = happened + once, max(most, once)
        for seed in seeds:
            fault_injection.assert_same_run(killed / seed, whole / seed)
    assert most >= 20 or words is not LONG
    fault_injection.tell(
        request, f"{happened} kills ({request.node.callspec.id}, up to {most} in a row), 0 lost updates"
    )
