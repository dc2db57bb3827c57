"""Gauss–Newton fit of a vehicle's parameters to segments of flights, with intervals; held-out errors."""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from qrl.identification import flight_log
from qrl.identification import model as free
from qrl.identification.flight_log import Segments
from qrl.identification.model import Model

Z_95 = 1.96
FLOORS = np.repeat([2e-4, 2e-4, 2e-3, 2e-3], 3)  # least scales of errors [m, rad, m/s, rad/s]: of single precision
OUTLIER = 2.0  # times the median error of segments, above which one counts linearly, not by its square
FIRST_LEADS = 3  # compared at first: later ones say little until the vehicle is nearly right
ROUNDS, STEPS = 2, 8  # in which errors are rescaled; of Gauss–Newton, at most, in each
ENOUGH = 1e-3  # share of its squares that a step must take away for another to follow
LEAST_EXPLAINED = 0.8  # of the change of body rates by the commands, for a fitted inertia to be the vehicle's
TORQUE = ("inertia", "yaw_moment")  # which else is no more than what predicts the log
# Half the width of a 95 % interval above which a parameter keeps the file's value. Factors by their logarithm.
WIDE = {
    "curve": 0.25,
    "lag": 0.3,
    "rise": 0.3,
    "drag_1_s": 0.15,
    "drag_height": 0.5,
    "inertia": 0.3,
    "yaw_moment": 0.3,
    "latency_s": 0.01,
}


class Fit(NamedTuple):
    """P parameters."""

    theta: np.ndarray  # [P]
    file: np.ndarray  # [P] of the vehicle alone, without what is the log's own
    covariance: np.ndarray  # [P, P]; 0 of what is not fitted
    fitted: np.ndarray  # [P] bool
    half_width: np.ndarray  # [P] of the 95 % interval when last fitted; inf of what was not
    explained: float  # share of the change of body rates that the commands explain


class Program(NamedTuple):
    """Of one model: compiled once for each number of segments."""

    errors: Callable[[Segments, np.ndarray], np.ndarray]  # , [P] -> [S, L, 12]
    jacobian: Callable[[Segments, np.ndarray], np.ndarray]  # , [P] -> [S, L, 12, P]


def compiled(model: Model) -> Program:
    """What a fit of `model` evaluates; for several fits."""
    index = np.flatnonzero(model.free)

    def found(part: jax.Array, whole: jax.Array, segments: Segments) -> jax.Array:
        return free.found_errors(model, whole.at[index].set(part), segments)

    plain, slopes = jax.jit(found), jax.jit(jax.jacfwd(found))

    def errors(segments: Segments, theta: np.ndarray) -> np.ndarray:
        whole = jnp.asarray(theta, jnp.float32)
        return np.asarray(plain(whole[index], whole, segments), np.float64)

    def jacobian(segments: Segments, theta: np.ndarray) -> np.ndarray:
        whole = jnp.asarray(theta, jnp.float32)
        by = np.asarray(slopes(whole[index], whole, segments))
        every = np.zeros((*by.shape[:-1], len(theta)), np.float32)
        every[..., index] = by
        return every

    return Program(errors, jacobian)


def fit(
    model: Model, segments: Segments, report: Callable[[str], None] = lambda _: None, program: Program | None = None
) -> Fit:
    """The parameters for which the plant flies `segments` as the log says, by Levenberg's and Marquardt's damped steps.

    Errors are weighted by their own size for each lead time and kind; the covariance is the sandwich estimate with
    segments as independent units (White; Liang and Zeger). What is wide by WIDE keeps its value in the file,
    the widest first, and the others are fitted again.
    """

    errors, jacobian = (partial(of, segments) for of in program or compiled(model))
    bound = _Bound(model, errors, jacobian)
    names, given = np.array(model.names), model.given
    active, first = model.free.copy(), np.where(names == "lag", 0.0, given)
    theta = first
    for leads in (FIRST_LEADS, None):
        theta, _ = _converged(bound, theta, active, leads)
    explained = _explained(errors(theta), segments, int(flight_log.leads(model.period_s)[1]))
    widths = np.full(len(theta), np.inf)
    limits = np.array([WIDE.get(name, np.inf) for name in names])
    if explained < LEAST_EXPLAINED:
        limits[np.isin(names, TORQUE)] = np.inf
    rounds, (low, high) = ROUNDS, model.bounds
    while True:
        weights = np.zeros(0)
        for _ in range(rounds):
            theta, weights = _converged(bound, theta, active, None)
        covariance, half = _covariance(bound, theta, weights, active)
        widths[active] = half[active]
        ratio = np.where(active, half / limits, 0.0)
        if not (wide := ratio > 1.0).any():
            # What the file takes over: latency is the log's, and so is inertia where it stands for noise of commands.
            log_own = ["latency_s", *(TORQUE if explained < LEAST_EXPLAINED else ())]
            file = np.where(np.isin(names, log_own), given, theta)
            return Fit(theta, file, covariance, active, widths, explained)
        # What is no part of a vehicle first: latency and lag look alike where commands change slowly.
        latency = np.flatnonzero(wide & (names == "latency_s"))
        worst = int(latency[0] if len(latency) else np.argmax(ratio))
        report(f"{names[worst]}: its interval is wide (± {half[worst]:.2g}); the file's value stays")
        active[worst], rounds = False, 1
        if names[worst] == "lag":
            active[names == "rise"] = False  # a ratio to what is not known
        theta = np.where(active & (theta > low) & (theta < high), theta, first)
        theta[~active] = given[~active]


class _Bound(NamedTuple):
    model: Model
    errors: Callable[[np.ndarray], np.ndarray]
    jacobian: Callable[[np.ndarray], np.ndarray]


def _explained(errors: np.ndarray, segments: Segments, steps: int) -> float:
    """The share of the change of roll and pitch rates over the second lead time, about each flight's median, that the
    model predicts. Commands that were sampled slower than they changed say less than the motors did; a fit would then
    take the noise for inertia (errors in variables).
    """
    change = segments.measured[:, steps, 10:12] - segments.measured[:, 0, 10:12]
    own = [segments.flight == flight for flight in np.unique(segments.flight)]

    def spread(x: np.ndarray) -> float:
        return float(np.median(np.concatenate([(x[i] - np.median(x[i], axis=0)) ** 2 for i in own])))

    return 1.0 - spread(errors[:, 1, 9:11]) / max(spread(change), 1e-12)


def _converged(
    bound: _Bound, theta: np.ndarray, active: np.ndarray, leads: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """Parameters after steps at fixed weights, and these, of squared errors: [S, L, 12], of the first `leads` times."""
    errors = bound.errors(theta)
    weights = _weights(errors, leads)
    low, high = bound.model.bounds
    cost, damping = float(np.sum(weights * errors**2)), 1e-3
    for _ in range(STEPS):
        curvature, slope, _ = _normal(errors, bound.jacobian(theta)[..., active], weights)
        before = cost
        while damping < 1e6:
            damped = curvature + damping * np.diag(np.maximum(np.diag(curvature), 1e-12))
            proposal = theta.copy()
            proposal[active] = np.clip(theta[active] - np.linalg.solve(damped, slope), low[active], high[active])
            tried = bound.errors(proposal)
            value = float(np.sum(weights * tried**2))
            if value < cost:
                theta, cost, errors, damping = proposal, value, tried, max(damping / 10.0, 1e-9)
                break
            damping *= 10.0
        if before - cost < ENOUGH * before:
            break
    return theta, weights


def _normal(errors: np.ndarray, jacobian: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Curvature [P, P] and slope [P] of half the sum of weighted squares, and the slope by segment [S, P]."""
    root = np.sqrt(weights)
    j = (jacobian * root[..., None]).astype(np.float64).reshape(len(errors), -1, jacobian.shape[-1])
    e = (errors * root).reshape(len(errors), -1)
    each = np.einsum("skp,sk->sp", j, e)
    flat = j.reshape(-1, j.shape[-1])
    return flat.T @ flat, each.sum(axis=0), each


def _weights(errors: np.ndarray, leads: int | None) -> np.ndarray:
    """Of squared errors [S, L, 12]: one over the variance of each kind at each lead time, less of outlying segments."""
    size = 1.4826 * np.median(np.abs(errors), axis=0)
    scale = np.maximum(np.sqrt(np.mean(size.reshape(-1, 4, 3) ** 2, axis=2)).repeat(3, axis=1), FLOORS)
    weights = np.broadcast_to(1.0 / scale**2, errors.shape).copy()
    if leads is not None:
        weights[:, leads:] = 0.0
    own = np.sqrt(np.mean(weights * errors**2, axis=(1, 2)))
    limit = OUTLIER * max(float(np.median(own)), 1e-12)
    return weights * np.minimum(1.0, limit / np.maximum(own, limit))[:, None, None]


def _covariance(
    bound: _Bound, theta: np.ndarray, weights: np.ndarray, active: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The sandwich estimate: curvature⁻¹ · (sum over segments of slope·slopeᵀ) · curvature⁻¹; [P, P].
    And half the widths of intervals [P], which are those of curvature⁻¹ where these are wider."""
    curvature, _, each = _normal(bound.errors(theta), bound.jacobian(theta)[..., active], weights)
    size = np.sqrt(np.maximum(np.diag(curvature), 1e-30))
    values, vectors = np.linalg.eigh(curvature / size / size[:, None])
    inverse = (vectors / np.maximum(values, 1e-10)) @ vectors.T / size / size[:, None]
    count = len(each)
    covariance = np.zeros((len(active), len(active)))
    covariance[np.ix_(active, active)] = count / max(count - 1, 1) * inverse @ each.T @ each @ inverse
    # Where nothing depends on a parameter its slopes say nothing either: the curvature tells.
    least = np.zeros(len(active))
    least[active] = np.diag(inverse)
    return covariance, Z_95 * np.sqrt(np.maximum(np.diag(covariance), least))


class HeldOut(NamedTuple):
    """Open-loop flights of S segments that the fit has not seen, by the starting vehicle and by the fitted one."""

    lead_s: np.ndarray  # [L]
    measured: np.ndarray  # [S, L, 13] position, attitude, velocity, body rates
    start: np.ndarray  # [S, L, 13] predicted
    fitted: np.ndarray  # [S, L, 13] with what is the log's own
    start_m: np.ndarray  # [S, L] distance of the predicted position from the measured one
    fitted_m: np.ndarray  # [S, L]
    file_m: np.ndarray  # [S, L] of the fitted vehicle's file alone
    constant_velocity_m: np.ndarray  # [S, L] of a vehicle that keeps the velocity of the segment's start


def held_out(model: Model, fit: Fit, segments: Segments) -> HeldOut:
    """What both vehicles predict of `segments`."""
    fly = jax.jit(lambda theta: free.predicted(model, theta, segments))
    each = (model.given, fit.theta, fit.file)
    start, fitted, file = (np.asarray(fly(jnp.asarray(x, jnp.float32)), np.float64) for x in each)
    at = flight_log.leads(model.period_s)
    lead_s, measured, first = at * model.period_s, segments.measured[:, at], segments.measured[:, :1]
    still = first[..., :3] + lead_s[:, None] * first[..., 7:10]
    distances = (np.linalg.norm(x[..., :3] - measured[..., :3], axis=-1) for x in (start, fitted, file, still))
    return HeldOut(lead_s, measured, start, fitted, *distances)
