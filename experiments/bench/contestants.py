"""The contestants of each benchmark. Their scripts and requirements are in experiments/baselines."""

from typing import NamedTuple

GROUPS = {
    "pendulum": "Pendulum-v1, until the mean return of 1,000 starts reaches −150",
    "hover": "hover, until 99 % of 1,000 starts succeed",
    "circle": "circle, until 99 % of 1,000 starts succeed",
    "commands": "complete commands with the shipped defaults, the final policy evaluated",
    "speed": "steps and samples a second",
    "judges": "exported kernels in other people's simulators",
}
JUDGES = "judges"  # of this group a contestant is a vehicle of a judge, and is flown once, not timed


class Contestant(NamedTuple):
    name: str
    group: str
    script: str
    words: tuple[str, ...] = ()
    environment: str | None = None  # requirements of that name; None: qrl's own
    devices: int | None = None  # CPU devices given to JAX; None: the contestant's own choice


QRL = "qrl"  # the contestant of each group that ratios refer to

CONTESTANTS = (
    Contestant("qrl", "pendulum", "qrl_train.py", ("pendulum",)),
    Contestant("Brax PPO", "pendulum", "brax_ppo.py", ("pendulum", "--steps", "1e6"), "brax"),
    Contestant("rejax SAC", "pendulum", "rejax_agent.py", ("sac", "--steps", "2e4"), "rejax"),
    Contestant("rejax PPO", "pendulum", "rejax_agent.py", ("ppo", "--steps", "1e6"), "rejax"),
    Contestant("sbx SAC", "pendulum", "sbx_sac.py", ("--steps", "2e4"), "sbx"),
    Contestant("rltools SAC", "pendulum", "rltools_sac.py", ("--steps", "2e4"), "rltools"),
    Contestant("qrl", "hover", "qrl_train.py", ("hover",)),
    Contestant("qrl without APG", "hover", "qrl_train.py", ("hover", "--no-apg")),
    Contestant("Brax PPO", "hover", "brax_ppo.py", ("hover", "--steps", "4e6"), "brax"),
    Contestant("qrl", "circle", "qrl_train.py", ("circle",)),
    Contestant("qrl without APG", "circle", "qrl_train.py", ("circle", "--no-apg")),
    Contestant("Brax PPO", "circle", "brax_ppo.py", ("circle", "--steps", "3e6"), "brax"),
    Contestant("qrl train pendulum", "commands", "qrl_command.py", ("pendulum",)),
    Contestant("qrl train hover", "commands", "qrl_command.py", ("hover",)),
    Contestant("qrl train circle", "commands", "qrl_command.py", ("circle",)),
    Contestant("qrl", "speed", "../profiling/throughput.py"),
    Contestant("qrl, one core", "speed", "qrl_cores.py", ("--processes", "1")),
    Contestant("qrl, a process a core", "speed", "qrl_cores.py"),
    Contestant("Brax", "speed", "brax_speed.py", (), "brax"),
    Contestant("Brax, two devices", "speed", "brax_speed.py", ("--only", "training"), "brax", devices=2),
    Contestant("crazyflow", "speed", "crazyflow_physics.py", ("first_principles",), "crazyflow"),
    Contestant("crazyflow so_rpy", "speed", "crazyflow_physics.py", ("so_rpy",), "crazyflow"),
    Contestant("qrl command", "speed", "qrl_startup.py", ("hover",)),
    Contestant("qrl seeds", "speed", "qrl_seeds.py", ("pendulum", "--preset", "pendulum_fast")),
    Contestant("rotorpy crazyflie", JUDGES, "rotorpy_flights.py", ("crazyflie",), "rotorpy"),
    Contestant("rotorpy hummingbird", JUDGES, "rotorpy_flights.py", ("hummingbird",), "rotorpy"),
    Contestant("crazyflow cf21B_500", JUDGES, "crazyflow_flights.py", ("cf21B_500",), "crazyflow_judge"),
    Contestant("crazyflow cf2x_L250", JUDGES, "crazyflow_flights.py", ("cf2x_L250",), "crazyflow_judge"),
)


def key(contestant: Contestant) -> str:
    """The contestant's name in files and on the command line: `pendulum/brax-ppo`."""
    return f"{contestant.group}/{contestant.name.lower().replace(',', '').replace(' ', '-')}"


def chosen(words: list[str]) -> list[Contestant]:
    """The contestants named by `words` (groups or keys), in the order of CONTESTANTS; raises ValueError."""
    known = {key(contestant) for contestant in CONTESTANTS} | GROUPS.keys()
    for word in words:
        if word not in known:
            raise ValueError(f"--only: unknown contestant '{word}' (known: {', '.join(sorted(known))})")
    return [c for c in CONTESTANTS if not words or {key(c), c.group} & set(words)]
