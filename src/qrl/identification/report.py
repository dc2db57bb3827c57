"""What a fit found: each number of the vehicle's file with its interval, the fitted file, and held-out errors."""

import copy
from typing import Any, NamedTuple

import numpy as np

from qrl.identification.fit import LEAST_EXPLAINED, TORQUE, Z_95, Fit, HeldOut
from qrl.identification.model import NO_LAG_S, Model
from qrl_envs import specfile
from qrl_envs.specfile import BadInput
from qrl_envs.vehicle import Vehicle, with_default_scale


class Row(NamedTuple):
    """One number: as the file has it, as fitted, and its 95 % interval."""

    name: str
    start: float
    value: float
    low: float
    high: float
    kept: str  # why the file's value stays, or ""


def rows(model: Model, fit: Fit) -> list[Row]:
    """The numbers of the vehicle's file, then the latency of the commands in the log."""
    v, names = model.vehicle, np.array(model.names)
    poor = fit.explained < LEAST_EXPLAINED
    arm = model.arm_m

    def row(name: str, start: float, weights: np.ndarray, scale: float | None = None) -> Row:
        """Of a combination of parameters: what is added to `start` by `scale`, or the logarithm of its factor."""
        parts = np.flatnonzero(weights)
        fitted = bool(fit.fitted[parts].any()) and not (poor and {*names[parts]} <= {*TORQUE})
        offset, half = float(weights @ fit.theta), Z_95 * float(np.sqrt(weights @ fit.covariance @ weights))
        ends = np.array([offset, offset - half, offset + half])
        if scale is None:
            base = start or model.lag_s[0]
            value, low, high = base * np.exp(ends) if fitted else (start,) * 3
        else:
            value, low, high = start + scale * ends if fitted else (start,) * 3
        return Row(name, start, float(value), float(low), float(high), "" if fitted else _why(model, fit, parts))

    def one(name: str, index: int = 0) -> np.ndarray:
        return np.eye(len(names))[np.flatnonzero(names == name)[index]]

    found = []
    if model.thrust:
        found.append(row("mass_kg", v.mass_kg, one("mass")))
        found += [row(f"center of mass {axis} [m]", 0.0, one("center_m", i), 1.0) for i, axis in enumerate("xy")]
    else:
        first = np.flatnonzero(names == "thrust")
        for i, motor in enumerate(v.motors):
            weights = np.zeros(len(names))
            weights[first] = model.modes[i]
            found.append(row(f"motors[{i + 1}].max_N", motor.max_N, weights))
    found.append(row("thrust_curve", v.thrust_curve, one("curve"), 1.0))
    found.append(row("rotor_rise_s", v.rotor_rise_s, one("lag") + one("rise")))
    found.append(row("rotor_fall_s", v.rotor_fall_s, one("lag") - one("rise")))
    found += [row(f"drag_N_s_m {axis}", v.drag_N_s_m[i], one("drag_1_s", i), v.mass_kg) for i, axis in enumerate("xyz")]
    found.append(row("drag_height_m", v.drag_height_m, one("drag_height"), arm))
    found += [
        row(f"inertia_kg_m2 {axis}", v.inertia_kg_m2[i], one("inertia")) for i, axis in enumerate(("xx", "yy", "zz"))
    ]
    found.append(row("yaw_moment_m", v.yaw_moment_m, one("yaw_moment")))
    found.append(row("latency [s]", 0.0, one("latency_s"), 1.0))
    return found


def _why(model: Model, fit: Fit, parts: np.ndarray) -> str:
    if fit.fitted[parts].any():
        return f"kept: what was found is the log's (commands explain {max(fit.explained, 0.0):.0%} of the rotation)"
    return "kept: the log leaves it open (its 95 % interval was wide)"


def fitted_data(model: Model, fit: Fit, start: dict[str, Any], source: str) -> dict[str, Any]:
    """The fitted vehicle's file: `start` with the numbers that were fitted; BadInput where it could not fly."""
    data, found = copy.deepcopy(start), {row.name: row for row in rows(model, fit)}

    def value(name: str) -> float:
        return float(f"{found[name].value:.6g}")

    if model.thrust:
        data["mass_kg"] = value("mass_kg")
        center = [found[f"center of mass {axis} [m]"].value for axis in "xy"]
        for motor in data["motors"]:
            x, y, *z = motor["position_m"]
            motor["position_m"] = [float(f"{x - center[0]:.6g}"), float(f"{y - center[1]:.6g}"), *z]
    else:
        for i, motor in enumerate(data["motors"]):
            motor["max_N"] = value(f"motors[{i + 1}].max_N")
    lags = [value("rotor_rise_s"), value("rotor_fall_s")]
    names: dict[str, Any] = {
        "thrust_curve": value("thrust_curve"),
        "yaw_moment_m": value("yaw_moment_m"),
        "drag_height_m": value("drag_height_m"),
    }
    names |= dict(zip(("rotor_rise_s", "rotor_fall_s"), lags if max(lags) > 2 * NO_LAG_S else (0.0, 0.0), strict=True))
    factor = found["inertia_kg_m2 xx"].value / found["inertia_kg_m2 xx"].start
    names["inertia_kg_m2"] = [float(f"{factor * x:.6g}") for x in start["inertia_kg_m2"]]
    names["drag_N_s_m"] = [max(value(f"drag_N_s_m {axis}"), 0.0) for axis in "xyz"]
    data = {"source": source, **{k: x for k, x in data.items() if k != "source"}, **names}
    try:
        specfile.build(Vehicle, with_default_scale(data), "the fitted vehicle")
    except BadInput as error:
        raise BadInput(f"{error}: do the logs fit the starting vehicle?") from None
    return data


def summary(found: HeldOut) -> dict[str, float | int | None]:
    """Medians over held-out segments of the position error at the last lead time [mm], and their ratio."""
    each = (found.start_m, found.fitted_m, found.file_m)
    start, fitted, file = (1e3 * float(np.median(x[:, -1])) for x in each)
    return {
        "segments": len(found.start_m),
        "horizon_s": float(found.lead_s[-1]),
        "start_mm": start,
        "fitted_mm": fitted,
        "ratio": fitted / start if start > 0.0 else None,
        "file_mm": file,
        "file_ratio": file / start if start > 0.0 else None,
        "constant_velocity_mm": 1e3 * float(np.median(found.constant_velocity_m[:, -1])),
    }
