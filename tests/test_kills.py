"""A run that is killed at any moment, again and again, ends as one never stopped: bit for bit, clocks aside."""

import random
import time
from pathlib import Path

import pytest

import campaign
from campaign import TORTURE, TRAIN

SAMPLE = [pytest.param("one", 3, {}, (), id="3 kills")]
ALL = [
    pytest.param("one", 60, {}, (), id="60 kills"),
    pytest.param("seeds", 24, {}, ("--seeds", "2"), id="24 kills of two seeds"),
    pytest.param("devices", 24, {"JAX_NUM_CPU_DEVICES": "2"}, (), id="24 kills on two devices"),
]


@pytest.mark.parametrize(("name", "kills", "variables", "words"), ALL if TORTURE else SAMPLE)
def test_killed_run_equals_one_never_stopped(
    request: pytest.FixtureRequest,
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
    name: str,
    kills: int,
    variables: dict[str, str],
    words: tuple[str, ...],
) -> None:
    """By SIGTERM, SIGINT and SIGKILL in turn, while it loads, compiles, trains, saves and draws."""
    if name == "one":
        whole = campaign.whole_run(tmp_path_factory)
    else:
        whole = tmp_path / "whole"
        campaign.done(campaign.qrl(*TRAIN, *words, "--out", whole, **variables))
    begun = time.monotonic()
    if TORTURE:  # how long one takes whose programs are compiled
        campaign.done(campaign.qrl(*TRAIN, *words, "--out", tmp_path / "again", **variables))
    seconds = max(time.monotonic() - begun, 8.0)
    seeds = ("seed-0", "seed-1") if "--seeds" in words else (".",)
    happened, again = 0, 0
    while happened < kills:  # a run that ended too early counts as far as it went
        again += 1
        killed = tmp_path / f"killed-{again}"
        draw = random.Random(f"{name} {again}")
        happened += campaign.killed_again_and_again(
            [*TRAIN, *words, "--out", killed, "--resume"],
            [killed / seed for seed in seeds],
            kills - happened,
            draw,
            seconds,
            **variables,
        )
        for seed in seeds:
            campaign.assert_same_run(killed / seed, whole / seed)
    campaign.tell(request, f"{happened} kills ({request.node.callspec.id}, in {again} runs), 0 lost updates")
