"""crazyflow's physics alone on a CPU, in steps a second: `crazyflow_physics.py --seed N`.

Its first-principles dynamics (rotors, drag and all) told rotor speeds, symplectic Euler as ours, no controller, at
100 Hz: the nearest to our quadrotor's step. Its step does more than ours, and both are what a user gets.
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


def physics(lanes: int, seed: int) -> None:
    sim = Sim(
        n_worlds=lanes,
        dynamics=Dynamics.first_principles,
        control=Control.rotor_vel,
        integrator=Integrator.symplectic_euler,
        freq=FREQUENCY_HZ,
        device="cpu",
        rng_key=seed,
    )
    sim.reset()
    sim.rotor_vel_control(jnp.full((lanes, 1, 4), 10_000.0))

    def step(_: object) -> None:
        sim.step(UNROLL_STEPS)

    rate(f"physics, {lanes:,} lanes", lanes * UNROLL_STEPS, step, None, lambda _: jax.block_until_ready(sim.data))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seed", type=int, default=0)
    for lanes in LANES:
        physics(lanes, parser.parse_args().seed)


if __name__ == "__main__":
    main()
