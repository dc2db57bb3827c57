"""The caption of each figure: how it was made, the paper's claim, what was measured, and a verdict.

Every number here is computed from the runs. The rule of each verdict is in its caption.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from experiments.figures.flights import PolicyFlights
from experiments.figures.plots import PUBLISHED, Curves, Rate, thousands
from experiments.figures.runs import PAPER_RATES, RunSpec
from experiments.statistics import format_interval, interquartile_mean
from qrl import tasks
from qrl.runs.record import RunConfig
from qrl_envs.off_nominal import TRIAL_POSITION_M, TRIAL_VELOCITY_M_S
from qrl_envs.task import CircleReward

OVER_SEEDS = "interquartile mean (IQM), and its bootstrap interval of 95 %,"
CONFIRMED, EXCEEDED, NOT = "confirmed", "exceeded", "not confirmed"
SOLVED = 0.99  # success of a report at which a task counts as solved
PAPER_HOVER_STEPS = 10e6
PAPER_CIRCLE_EPISODES = 1.0e6
PAPER_EPISODE_STEPS = 200
IDLE = 0.2  # fraction of the largest gain, below which a run has hardly learned
HARMONIC = 0.05  # tolerance of amplitudes and residual, as a fraction of the reference speed


class Caption(NamedTuple):
    title: str
    shows: str
    claim: str
    found: list[str]  # lines of Markdown
    rule: str  # of the verdict
    verdict: str


class Provenance(NamedTuple):
    """How a figure was made."""

    command: str
    commit: str  # of the code that drew it
    note: str  # "" or a sentence
    runs: Sequence[tuple[RunSpec, Path]]


def page(caption: Caption, provenance: Provenance) -> str:
    """The caption as Markdown."""
    configs = {one.name: tasks.load_run_config(folder) for one, folder in provenance.runs}
    commands = [
        f"- `{one.name}`: `{_command(one, configs[one.name])}`, {_seeds(configs[one.name])}"
        for one, _ in provenance.runs
    ]
    versions = {tuple(config.versions.items()) for config in configs.values()}
    said = [", ".join(f"{name} {version}" for name, version in one) for one in sorted(versions)]
    return "\n".join(
        [
            f"# {caption.title}",
            "",
            caption.shows,
            "",
            f"**The paper's claim.** {caption.claim}",
            "",
            "**Measured here.**",
            "",
            *caption.found,
            "",
            f"**Verdict: {caption.verdict}.** {caption.rule}",
            "",
            "## How it was made",
            "",
            f"`{provenance.command}` at commit {provenance.commit}{provenance.note}, from these runs:",
            "",
            *commands,
            "",
            f"Versions, and the commit that trained: {'; '.join(said)}.",
            "",
        ]
    )


def _command(one: RunSpec, config: RunConfig) -> str:
    """The command with its number of devices: on another number results agree only to rounding."""
    cpu = any("cpu" in device.lower() for device in config.devices)
    before = f"JAX_NUM_CPU_DEVICES={len(config.devices)} " if cpu else ""
    return f"{before}qrl {' '.join(one.words)}"


def _seeds(config: RunConfig) -> str:
    return f"seed {config.seed}" if config.seeds == 1 else f"seeds {config.seed}–{config.seed + config.seeds - 1}"


# Learning curves


def pendulum(rates: list[Rate]) -> Caption:
    lines = ["| learning rate | ours: return at the end | PPO | better |", "|---|---|---|---|"]
    floor = min(float(np.median(c.returns[:, 0])) for rate in rates for c in (rate.ours, rate.ppo))
    gains = {rate.title: max(gain(rate.ours, floor), gain(rate.ppo, floor)) for rate in rates}
    idle = [title for title, much in gains.items() if much < IDLE * max(gains.values())]
    verdicts = []
    for rate in rates:
        ours, ppo = rate.ours.returns[:, -1], rate.ppo.returns[:, -1]
        better, all_better = interquartile_mean(ours).low > interquartile_mean(ppo).high, ours.min() > ppo.max()
        if rate.title not in idle:
            verdicts.append(EXCEEDED if all_better else CONFIRMED if better else NOT)
        said = "ours, every seed" if all_better else "ours" if better else "not ours, or not beyond the intervals"
        lines.append(f"| {rate.title} | {format_interval(ours)} | {format_interval(ppo)} | {said} |")
    if idle:
        lines += ["", f"Within these steps hardly anything is learned by either at: {'; '.join(idle)}."]
    high, low = PAPER_RATES["high"], PAPER_RATES["low"]
    first = rates[0].ours
    return Caption(
        "Pendulum: learning curves at two learning rates, against PPO",
        f"Return of 200 steps over environment steps: {OVER_SEEDS} of {first.seeds} seeds,"
        f" {thousands(first.steps[-1])} steps each. Ours is the paper's method, on- and off-policy; PPO is the same"
        " learner with a replay buffer of one unroll and GAE(0.95). Neither is augmented by the task's symmetries."
        f" The paper's learning rates are {high:g} and {low:g}, held constant here; this recipe's are its preset's"
        f" (with its schedule), and the same divided by {high / low:g}, the ratio of the paper's two.",
        "At both of its learning rates the combined method does slightly better than a minimally tuned PPO.",
        lines,
        f"Over the {len(verdicts)} of {len(rates)} rates at which one of the two learns (gains {IDLE:.0%} or more of"
        " the largest gain): confirmed, if at each of them the interval of our return at the end lies above PPO's;"
        " exceeded, if at each our worst seed is above PPO's best.",
        NOT if NOT in verdicts else CONFIRMED if CONFIRMED in verdicts else EXCEEDED,
    )


def gain(curves: Curves, floor: float) -> float:
    """The median return at the end, above `floor`."""
    return float(np.median(curves.returns[:, -1])) - floor


def hover(curves: Curves) -> Caption:
    solved = solved_at(curves)
    last, success = curves.returns[:, -1], curves.success[:, -1]
    verdict = EXCEEDED if solved.max() < PAPER_HOVER_STEPS else CONFIRMED if np.median(solved) <= 10e6 else NOT
    reference = ", ".join(f"{value:g} at {thousands(steps)}" for steps, value in PUBLISHED)
    return Caption(
        "Hover: learning curves",
        f"Return of 200 steps and success over environment steps: {OVER_SEEDS} of {curves.seeds}"
        f" seeds. For reference the authors' published checkpoints, flown in the same way"
        f" ({reference}).",
        f"{thousands(PAPER_HOVER_STEPS)} time steps are enough for a policy that hovers steadily (two runs).",
        [
            *_solved_lines(curves, solved),
            f"- At the end, {thousands(curves.steps[-1])} steps: return {format_interval(last)}, success"
            f" {format_interval(100 * success, '.0f')} %. The published checkpoints reach {PUBLISHED[-1][1]:g} at"
            f" {thousands(PUBLISHED[-1][0])}.",
        ],
        f"Hovering steadily: from {SOLVED:.0%} of a report's starts or more, within 0.1 m throughout the last 2 s, in"
        " that report and all later ones."
        f" Confirmed: the median seed does by {thousands(PAPER_HOVER_STEPS)} steps; exceeded: every seed does earlier.",
        verdict,
    )


def circle(curves: Curves, episode_steps: int) -> Caption:
    """`episode_steps`: this run's maximum; steps are converted to episodes of the paper's length."""
    solved = solved_at(curves)
    episodes = solved / PAPER_EPISODE_STEPS
    verdict = (
        EXCEEDED
        if episodes.max() < PAPER_CIRCLE_EPISODES
        else CONFIRMED
        if np.median(episodes) <= PAPER_CIRCLE_EPISODES
        else NOT
    )
    return Caption(
        "Circle: learning curves",
        f"Return of 200 steps and success over environment steps: {OVER_SEEDS} of {curves.seeds}"
        f" seeds. The weights of the reward are ours (the paper gives none), so returns cannot be"
        f" compared with the paper's.",
        f"The controller has learned to fly the circle after around {PAPER_CIRCLE_EPISODES / 1e6:.1f} million training"
        f" episodes, of at most {PAPER_EPISODE_STEPS} steps (two runs).",
        [
            *_solved_lines(curves, solved),
            f"- In the paper's episodes of {PAPER_EPISODE_STEPS} steps that is {_counts(episodes)}; episodes here are"
            f" of up to {episode_steps} steps.",
            f"- At the end, {thousands(curves.steps[-1])} steps: return {format_interval(curves.returns[:, -1])},"
            f" success {format_interval(100 * curves.success[:, -1], '.0f')} %.",
        ],
        f"Flying the circle: from {SOLVED:.0%} of a report's starts or more, within 0.1 m of it and 0.2 m/s of 2 m/s"
        f" throughout the last 4 s, in that report and all later ones. Confirmed: the median seed does by"
        f" {PAPER_CIRCLE_EPISODES / 1e6:.1f} million episodes of {PAPER_EPISODE_STEPS} steps; exceeded: every seed does"
        " earlier.",
        verdict,
    )


def solved_at(curves: Curves) -> np.ndarray:
    """Environment steps at the first report of each seed from which success stays at SOLVED or more, [seeds]; infinite
    where there is none."""
    held = np.logical_and.accumulate((curves.success >= SOLVED)[:, ::-1], axis=1)[:, ::-1]
    return np.where(held.any(axis=1), curves.steps[np.argmax(held, axis=1)], np.inf)


def _solved_lines(curves: Curves, solved: np.ndarray) -> list[str]:
    count = int(np.isfinite(solved).sum())
    return [
        f"- {count} of {curves.seeds} seeds reach a success of {SOLVED:.0%} or more and keep it in every later"
        f" report, after {_counts(solved)} steps."
    ]


def _counts(values: np.ndarray) -> str:
    """Median and range over seeds of steps or episodes; a seed that never reaches it ranks last."""
    low, median, high = np.sort(values)[[0, (len(values) - 1) // 2, -1]]
    names = [f"{value:,.0f}" if np.isfinite(value) else "never" for value in (median, low, high)]
    return f"{names[0]} [{names[1]} … {names[2]}] (median, range)"


# Flights


def trial(flown: PolicyFlights) -> Caption:
    share, settle = float(flown.measures["success"].mean()), flown.measures["settle_s"]
    worked = bool(flown.measures["success"][0])
    position, velocity = (", ".join(f"{x:g}" for x in triple) for triple in (TRIAL_POSITION_M, TRIAL_VELOCITY_M_S))
    return Caption(
        "Hover: x, y and z of the paper's trial",
        f"Position over time from [{position}] m at [{velocity}] m/s, deterministic policy of seed {flown.seed} after"
        f" {flown.env_steps:,} steps. The paper does not give the attitude: the thick lines' is the first start's of"
        f" `make evaluate`, as are the body rates; the thin ones' are those of the next four (a diverging one leaves"
        f" the window). In training no start is faster than {flown.task.start.velocity_m_s:g} m/s on any axis.",
        "From this start the vehicle comes to the origin and stays there.",
        [
            f"- The flight drawn thick {_settles(settle[0])} within {flown.task.evaluation.distance_m:g} m;"
            f" RMS distance in the last {flown.task.evaluation.tail_s:g} s:"
            f" {_mm(flown.measures['rms_position_m'][0])}.",
            f"- From {len(settle):,} attitudes and body rates: success {share:.1%}; the median"
            f" flight {_settles(_rank(settle, 0.5))}, the 95th percentile {_settles(_rank(settle, 0.95))}.",
        ],
        f"Confirmed: the flight drawn thick succeeds (within {flown.task.evaluation.distance_m:g} m throughout the last"
        f" {flown.task.evaluation.tail_s:g} s); exceeded: so do {SOLVED:.0%} or more of all attitudes.",
        NOT if not worked else EXCEEDED if share >= SOLVED else CONFIRMED,
    )


def from_above(flown: PolicyFlights, shown: int) -> Caption:
    success = flown.measures["success"]
    rms = flown.measures["rms_radius_m"][:shown]
    count = int(success[:shown].sum())
    target = _target(flown)
    return Caption(
        "Circle: five flights from above",
        f"Paths on the x-y plane of the first {shown} starts of `make evaluate`, {flown.times_s[-1]:g} s each,"
        f" deterministic policy of seed {flown.seed} after {flown.env_steps:,} steps; dashed the {target.radius_m:g} m"
        " reference.",
        f"From five different initial states the vehicle comes onto the {target.radius_m:g} m circle and follows it.",
        [
            f"- {count} of the {shown} succeed, with RMS radius errors in the last {flown.task.evaluation.tail_s:g} s"
            f" of {', '.join(map(_mm, rms))}.",
            f"- From all {len(success):,} starts of `make evaluate`: success {success.mean():.1%}, median RMS of"
            f" radius {_mm(np.median(flown.measures['rms_radius_m']))}, of height"
            f" {_mm(np.median(flown.measures['rms_height_m']))}.",
        ],
        f"Confirmed: all {shown} flights succeed (within {flown.task.evaluation.distance_m:g} m of the circle and"
        f" {flown.task.evaluation.speed_m_s:g} m/s of {target.speed_m_s:g} m/s throughout the last"
        f" {flown.task.evaluation.tail_s:g} s); exceeded: so do {SOLVED:.0%} or more of all starts.",
        NOT if count < shown else EXCEEDED if success.mean() >= SOLVED else CONFIRMED,
    )


def velocity(flown: PolicyFlights) -> Caption:
    amplitudes, rest, frequency = harmonic(flown)
    target = _target(flown)
    tail = flown.observations[0, -_tail(flown) :, 12:14]
    off = max(*np.abs(amplitudes - target.speed_m_s), rest) / target.speed_m_s
    return Caption(
        "Circle: velocity along x and y",
        f"vx and vy over time of the first flight of the figure from above; dotted ±{target.speed_m_s:g} m/s.",
        f"The velocities along x and y are simple harmonic motions with a maximum speed of {target.speed_m_s:g} m/s.",
        [
            f"- Sinusoids of one frequency fitted to the last {flown.task.evaluation.tail_s:g} s: amplitudes"
            f" {amplitudes[0]:.3f} m/s (vx) and {amplitudes[1]:.3f} m/s (vy) at {frequency:.3f} rad/s"
            f" ({target.speed_m_s / target.radius_m:g} rad/s would be exact); residual: {rest:.3f} m/s RMS.",
            f"- Greatest |vx| and |vy| there: {np.abs(tail[:, 0]).max():.3f} and {np.abs(tail[:, 1]).max():.3f} m/s.",
        ],
        f"Confirmed: both amplitudes' errors and the residual are within {HARMONIC:.0%} of {target.speed_m_s:g} m/s.",
        CONFIRMED if off <= HARMONIC else NOT,
    )


def harmonic(flown: PolicyFlights) -> tuple[np.ndarray, float, float]:
    """Amplitudes [2] [m/s] of the sinusoids fitted to vx and vy over the first flight's tail, the RMS [m/s] of the
    residual, and their angular frequency [rad/s], the mean rate at which the velocity's direction rotates there."""
    n = _tail(flown)
    t, v = flown.times_s[-n:], flown.observations[0, -n:, 12:14].astype(float)
    if not np.isfinite(v).all():
        return np.full(2, np.nan), np.inf, np.nan
    frequency = float(np.polyfit(t, np.unwrap(np.arctan2(v[:, 1], v[:, 0])), 1)[0])
    basis = np.stack([np.cos(frequency * t), np.sin(frequency * t)], axis=1)
    fit = np.linalg.lstsq(basis, v, rcond=None)[0]
    return np.hypot(*fit), float(np.sqrt(np.mean((v - basis @ fit) ** 2))), frequency


def _tail(flown: PolicyFlights) -> int:
    return round(flown.task.evaluation.tail_s / flown.task.control_period_s) + 1


def _target(flown: PolicyFlights) -> CircleReward:
    reward = flown.task.evaluation.reward
    assert isinstance(reward, CircleReward)
    return reward


def _rank(values: np.ndarray, share: float) -> float:
    """The quantile `share` without interpolation; infinite where too few are finite."""
    return float(np.sort(values)[round(share * (len(values) - 1))])


def _settles(seconds: float) -> str:
    return f"settles after {seconds:.2f} s" if np.isfinite(seconds) else "never settles"


def _mm(meters: float) -> str:
    return f"{1000.0 * meters:.1f} mm" if np.isfinite(meters) else "not finite (it ended early)"
