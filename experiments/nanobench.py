"""NanoBench's flights of a Crazyflie 2.1 as logs for `qrl identify`.

    python -m experiments.nanobench DATASET OUT     # DATASET: the folder datasets/dataset of syediu/nanobench-iros2026

Position and velocity are the motion capture's, attitude the onboard estimator's (the markers' frame jitters by a
degree), body rates the gyro's. A motor's command is its PWM share of the battery's voltage, of a full battery's 4.2 V:
what turns a brushed motor. Motors are in the firmware's order, as in the vehicle cf2x_l250. A flight is
kept from FLYING_M above the ground on, without its first and last second there.
"""

import argparse
import csv
from pathlib import Path

import numpy as np

FLYING_M, EDGE_S, LEAST_S = 0.5, 1.0, 5.0
FULL_BATTERY_V, FULL_PWM = 4.2, 65535.0
COLUMNS = {
    **{f"{axis}_m": f"p{axis}" for axis in "xyz"},
    **{f"q{part}": f"att_stateEstimate_q{part}" for part in "wxyz"},
    **{f"v{axis}_m_s": f"v{axis}" for axis in "xyz"},
    **{f"w{axis}_rad_s": f"imu_gyro_{axis}" for axis in "xyz"},
}


def converted(path: Path) -> tuple[list[str], np.ndarray] | None:
    """Header and rows of the log of a file of NanoBench; None where it does not fly long enough."""
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file))
    data = dict(zip(header, np.array(rows, float).T, strict=True))
    time_s = data["t"] - data["t"][0]
    above = np.flatnonzero(data["pz"] > FLYING_M)
    if not len(above) or time_s[above[-1]] - time_s[above[0]] < LEAST_S + 2 * EDGE_S:
        return None
    flown = (time_s >= time_s[above[0]] + EDGE_S) & (time_s <= time_s[above[-1]] - EDGE_S)
    columns = {"time_s": time_s} | {ours: data[theirs] for ours, theirs in COLUMNS.items()}
    norm = np.sqrt(sum(columns[f"q{part}"] ** 2 for part in "wxyz"))
    columns |= {f"q{part}": columns[f"q{part}"] / norm for part in "wxyz"}
    volts = data["pwr_pm_vbat"] / FULL_BATTERY_V
    columns |= {f"u{i}": np.clip(data[f"motor_motor_m{i}"] / FULL_PWM * volts, 0.0, 1.0) for i in range(1, 5)}
    return list(columns), np.stack(list(columns.values()), axis=1)[flown]


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description="NanoBench's flights as logs for qrl identify.")
    parser.add_argument("dataset", type=Path, metavar="DATASET")
    parser.add_argument("out", type=Path, metavar="OUT")
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    seen: set[bytes] = set()
    for path in sorted(args.dataset.glob("*.csv")):
        log = converted(path)
        if log is None or log[1].tobytes() in seen:  # some of its files are copies of others
            print(f"{path.name}: {'a copy' if log else 'no flight'}, left out")
            continue
        seen.add(log[1].tobytes())
        header = ",".join(log[0])
        np.savetxt(args.out / path.name, log[1], fmt="%.7g", delimiter=",", header=header, comments="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
