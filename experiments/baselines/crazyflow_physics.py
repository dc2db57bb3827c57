"""Steps/s of crazyflow's physics: `crazyflow_physics.py first_principles|so_rpy [--lanes N …] [--device gpu] --seed N`.

first_principles (rotors and drag included) takes rotor speeds and is closest to our quadrotor's step, though it
computes more; so_rpy, fitted to flights, takes attitude and thrust. Symplectic Euler, as ours, at 100 Hz.
"""

import argparse

import jax
import jax.numpy as jnp
from crazyflow.control import Control
from crazyflow.dynamics import Dynamics
from crazyflow.sim import Sim
from crazyflow.sim.integration import Integrator

from rates import LANES, UNROLL_STEPS, rate

FREQUENCY_HZ = 100


def physics(dynamics: Dynamics, lanes: int, seed: int, device: str) -> None:
    rotors = dynamics == Dynamics.first_principles
    sim = Sim(
        n_worlds=lanes,
        dynamics=dynamics,
        control=Control.rotor_vel if rotors else Control.attitude,
        integrator=Integrator.symplectic_euler,
        freq=FREQUENCY_HZ,
        attitude_freq=FREQUENCY_HZ,
        device=device,
        rng_key=seed,
    )
    sim.reset()
    if rotors:
        sim.rotor_vel_control(jnp.full((lanes, 1, 4), 10_000.0))
    else:
        sim.attitude_control(jnp.zeros((lanes, 1, 4)).at[..., 3].set(0.3))

    def step(_: object) -> None:
        sim.step(UNROLL_STEPS)

    rate(f"physics, {lanes:,} lanes", lanes * UNROLL_STEPS, step, None, lambda _: jax.block_until_ready(sim.data))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("dynamics", choices=["first_principles", "so_rpy"])
    parser.add_argument("--lanes", type=int, nargs="+", default=LANES)
    parser.add_argument("--device", choices=["cpu", "gpu"], default="cpu")
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    for lanes in args.lanes:
        physics(Dynamics(args.dynamics), lanes, args.seed, args.device)


if __name__ == "__main__":
    main()
