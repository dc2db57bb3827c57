"""`make gpu`: its refusal, its budget, its rows and pages, how it reads a trace; tiny, on the CPU that there is."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest

from experiments.bench.process import OUT_OF_TIME, follow
from experiments.gpu import run as gpu
from experiments.gpu import sections, trace
from qrl.config import Config, preset_names
from qrl_envs import env as worlds
from small_run import run_config

CPU = [{"platform": "cpu", "kind": "cpu", "memory_bytes": None}]
ABOUT = {"devices": "1 × abacus", "versions": {"qrl": "0"}}


@pytest.fixture(autouse=True)
def _one_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the processes that are started, whatever this machine has."""
    for name in ("JAX_NUM_CPU_DEVICES", "XLA_FLAGS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")


def test_without_a_gpu_it_is_refused_in_one_line(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """By what JAX itself finds here, where the tests have a CPU."""
    with pytest.raises(SystemExit) as ended:
        gpu.main(["--out", str(tmp_path / "out")])
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert "expected a GPU, and JAX has 1 × cpu" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["--only", "actng"], "invalid choice: 'actng'"),
        (["--budget-seconds", "nan"], "--budget-seconds above 0"),
        (["--lanes", "0"], "sizes of at least 1"),
        (["--out", __file__], "is a file"),
    ],
)
def test_wrong_input_gets_one_line(words: list[str], says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        gpu.main(words)
    said = capsys.readouterr().err
    assert ended.value.code == 2
    assert says in said
    assert said.count("\n") == 1


class Clock:
    """Time that passes when a section is run."""

    def __init__(self, takes: Callable[[float], float], monkeypatch: pytest.MonkeyPatch) -> None:
        self.now, self.given = 0.0, []
        monkeypatch.setattr(gpu.time, "monotonic", lambda: self.now)

        def run_section(section: Any, words: Any, seconds: float, report: Any) -> None:
            self.given.append(seconds)
            self.now += takes(seconds)

        monkeypatch.setattr(gpu, "run_section", run_section)


def measured(tmp_path: Path, budget: float, sections: list[gpu.Section]) -> list[dict]:
    args = gpu.argparse.Namespace(out=tmp_path, environments=tmp_path, budget_seconds=budget, call_steps=1)
    for name, (default, _) in gpu.SIZES.items():
        setattr(args, name, default)
    gpu.measure(sections, args, CPU)
    found = tmp_path / "gpu.json"
    return json.loads(found.read_text())["rows"] if found.exists() else []


THREE = [gpu.Section("plant", 1.0), gpu.Section("acting", 2.0), gpu.Section("hover", 1.0)]


def test_sections_that_take_their_time_share_the_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(lambda seconds: seconds, monkeypatch)
    assert measured(tmp_path, 400.0, THREE) == []
    assert clock.given == [100.0, 200.0, 100.0]
    assert clock.now == 400.0


def test_what_a_section_leaves_over_is_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(lambda seconds: min(seconds, 40.0), monkeypatch)
    measured(tmp_path, 400.0, THREE)
    assert clock.given == [100.0, 240.0, 320.0]


def test_a_section_that_is_not_reached_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that overran, by a pause of the machine, leaves nothing to those that follow."""
    clock = Clock(lambda seconds: 398.0, monkeypatch)
    rows = measured(tmp_path, 400.0, THREE)
    assert clock.given == [100.0]
    assert [(row["section"], row["failed"]) for row in rows] == [("acting", "not reached"), ("hover", "not reached")]


def test_a_peer_that_cannot_be_installed_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def python_of(*_: object) -> Path:
        raise gpu.NotInstalled("ERROR: no wheel")

    monkeypatch.setattr(gpu, "python_of", python_of)
    peer = next(section for section in gpu.SECTIONS if section.environment)
    (row,) = measured(tmp_path, 400.0, [peer])
    assert row["failed"] == "not installed: ERROR: no wheel"


def test_peers_are_told_sizes_and_device(tmp_path: Path) -> None:
    """No more lanes than fit; crazyflow on the card, where there is one."""
    args = gpu.argparse.Namespace(lanes=[1024, 2**20], training_lanes=[512])
    brax, crazyflow = (section for section in gpu.SECTIONS if section.script)
    assert gpu.command(brax, tmp_path, args, True)[2:] == ["--lanes", "1024", "--training-lanes", "512"]
    words = ["first_principles", "--lanes", "1024", "--device"]
    assert gpu.command(crazyflow, tmp_path, args, True)[2:] == [*words, "gpu"]
    assert gpu.command(crazyflow, tmp_path, args, False)[2:] == [*words, "cpu"]


def test_a_section_that_fails_is_a_row_after_those_it_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = 'print(\'BENCH {"figure": "a", "per_second": 3.0}\'); raise MemoryError(\'of a toy\')'
    report = gpu.Report(tmp_path, ABOUT)
    gpu.run_section(THREE[0], [gpu.sys.executable, "-c", script], 30.0, report)
    rows = json.loads((tmp_path / "gpu.json").read_text())["rows"]
    assert rows == [
        {"section": "plant", "figure": "a", "per_second": 3.0},
        {"section": "plant", "figure": "plant", "failed": "exit code 1: MemoryError: of a toy"},
    ]
    text = report.write_page()
    assert "| plant | a | 3/s |" in text
    assert "| plant | plant | exit code 1: MemoryError: of a toy |" in text


def test_lines_come_as_they_are_printed_and_the_command_ends_on_time() -> None:
    script = "import time; print('first', flush=True); time.sleep(60); print('last')"
    begun, came = time.monotonic(), []
    errors, ended = follow(
        [gpu.sys.executable, "-c", script], {}, 1.5, lambda line: came.append((line, time.monotonic()))
    )
    assert (errors, ended) == ("", OUT_OF_TIME)
    assert [line for line, _ in came] == ["first\n"]
    assert came[0][1] - begun < 1.4
    assert time.monotonic() - begun < 10.0


def test_a_measurement_that_fails_or_comes_too_late_is_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    def breaks() -> None:
        raise MemoryError("out of memory\nwhile trying to allocate")

    sizes = sections.Sizes((), (), (), (), ())
    sections.attempt(sizes, "a", breaks)
    sections.attempt(sizes._replace(deadline=0.0), "b", breaks)
    lines = [json.loads(line.removeprefix("BENCH ")) for line in capsys.readouterr().out.splitlines()]
    assert lines == [{"figure": "a", "failed": "MemoryError: out of memory"}, {"figure": "b", "failed": "not reached"}]


def test_a_section_in_small(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """In its process, on what there is: JSON, a page, and a figure for each plant."""
    words = ["--any-device", "--only", "plant", "--lanes", "8", "--call-steps", "400"]
    assert gpu.main([*words, "--out", str(tmp_path), "--budget-seconds", "100"]) == 0
    found = json.loads((tmp_path / "gpu.json").read_text())
    assert found["devices"] == "1 × cpu"
    rows = found["rows"]
    assert [row["figure"] for row in rows] == ["plant, real, 8 lanes", "plant, ideal, 8 lanes"]
    assert all(row["per_second"] > 0 for row in rows), rows
    page = (tmp_path / "gpu.md").read_text()
    assert page.startswith("# qrl on 1 × cpu\n")
    assert "| plant | plant, real, 8 lanes | " in page
    assert page in capsys.readouterr().out


def test_a_training_in_small(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Two seeds of a little pendulum, from the first state to the flights of what is deployed."""
    monkeypatch.setattr(sections, "run_of", lambda *_, **__: run_config(num_evals=2))
    monkeypatch.setattr(sections.tasks, "environment", lambda _: worlds.make("pendulum"))
    monkeypatch.setattr(sections, "evaluation_starts", lambda *_: jax.random.split(jax.random.PRNGKey(0), 6))
    sizes = sections.Sizes((), (), (), (), ())
    sections.attempt(sizes, "pendulum", sections.train, sizes, "pendulum", 2)
    (row,) = [json.loads(line.removeprefix("BENCH ")) for line in capsys.readouterr().out.splitlines()]
    assert "failed" not in row
    assert (row["figure"], row["starts"], row["done"], row["faults"]) == ("pendulum_gpu, 2 seeds", 6, 1.0, [])
    assert 0.0 <= row["success_mean"] <= 1.0


def test_the_largest_sizes_come_first(monkeypatch: pytest.MonkeyPatch) -> None:
    begun: list[tuple] = []
    monkeypatch.setattr(sections.throughput, "learning", lambda *args: begun.append((args[0], args[2])))
    monkeypatch.setattr(sections, "measure_apg", lambda figure, run, flights, steps: begun.append(flights))
    sizes = sections.Sizes((), (1600, 1_600_000), (64, 1024), (), (), call_steps=2**21)
    sections.learner(sizes)
    assert begun == [(32_000, 41), (32, 128)]  # trajectories of 50 samples, and updates of a call
    begun.clear()
    sections.apg(sizes)
    assert begun == [1024, 1024, 64, 64]


def test_every_section_is_measured_by_something() -> None:
    own = [section.name for section in gpu.SECTIONS if section.script is None]
    assert own == list(sections.MEASURES)
    assert all((gpu.BASELINES / section.script).is_file() for section in gpu.SECTIONS if section.script)
    for section in gpu.SECTIONS:
        for name in {section.environment, f"{section.environment}_cuda"} if section.environment else ():
            assert (gpu.BASELINES / f"{name}.txt").is_file()
    assert {bar.section for bar in gpu.BARS} <= {section.name for section in gpu.SECTIONS}


def test_the_cards_presets_have_thousands_of_lanes() -> None:
    presets = [name for name in preset_names() if name.endswith("_gpu")]
    assert presets == ["any_gpu", "circle_gpu", "hover_gpu", "track_gpu"]
    assert all(Config.preset(name).num_envs >= 4096 for name in presets)


def test_bars_are_read_off_the_best_figure() -> None:
    def rows(*found: dict) -> list[dict]:
        return [{"section": "acting", **row} for row in found]

    bar = gpu.Bar("", "acting", "acting, real", least_per_second=1.0)
    some = rows(
        {"figure": "acting, real, 8 lanes", "per_second": 2e8},
        {"figure": "acting, real, 16 lanes", "per_second": 3.5e9},
        {"figure": "acting, real, 32 lanes", "failed": "out of memory"},
        {"figure": "acting, ideal, 16 lanes", "per_second": 9e9},
    )
    assert gpu.against(bar, some) == "3.5G"
    assert gpu.against(bar, some[2:]) == "–"
    trained = {
        "section": "hover",
        "figure": "hover_gpu, 1 seed",
        "seconds": 0.8,
        "success_mean": 1.0,
        "success_min": 1.0,
    }
    bar = gpu.Bar("", "hover", "hover_gpu, 1 seed", most_seconds=1.0)
    assert gpu.against(bar, [trained]) == "0.8"
    assert gpu.against(bar, [trained | {"success_mean": 0.9, "success_min": 0.1}]) == "not: success 90.0% after 0.8"


def test_the_page_tells_what_was_trained_and_where_the_time_goes() -> None:
    trained = {
        "section": "hover",
        "figure": "hover_gpu, 1 seed",
        "seconds": 0.8,
        "compile_seconds": 12.3,
        "cache_hits": 1,
        "fly": 1,
        "starts": 1000,
        "success_mean": 0.995,
        "success_min": 0.995,
        "last_flies_at_seconds": 0.6,
        "done": 0.5,
        "faults": [],
    }
    (operation,) = trace.longest([trace.Span("gemm", 0.0, 2e6, 2e6)] * 1000)
    operations = [operation._asdict() | {"origin": "body/dot"}]
    profiled = {"section": "profile", "figure": "p", "seconds": 2.5, "busy": 0.8, "launches": 1000}
    text = gpu.page(ABOUT, [trained, profiled | {"operations": operations}])
    assert "0.80 s of training; 12.3 s of compiling, some of it from the cache; 1 fly (99 % of 1000 starts)" in text
    assert "by the reports after 0.60 s; stopped at 50% of the steps" in text
    assert "| profile | p | 2500.0 ms, device busy 80%, 1,000 launches |" in text
    assert text.endswith("| gemm | body/dot | 2000.00 | 100.0% | 1,000 |\n")


def test_an_unroll_fits_the_memory() -> None:
    """As many steps as take half of it, at least one, at most those of the bench."""
    assert sections.unroll_length(1024, 18, 60e9) == 50
    steps = sections.unroll_length(2**20, 43, 30e9)
    assert 1 < steps < 50
    assert sections.COPIES * 4 * (43 + 16) * 2**20 * steps <= 15e9
    assert sections.unroll_length(2**20, 43, 1e6) == 1


class Event(NamedTuple):
    name: str
    start_ns: float
    duration_ns: float
    stats: tuple = ()


class Line(NamedTuple):
    name: str
    events: list


class Plane(NamedTuple):
    name: str
    lines: list


class Data(NamedTuple):
    planes: list


def test_the_trace_of_a_card_is_its_streams() -> None:
    """Kernels by name, once: not the lines that say the same again; the device is idle between them."""
    first = [Event("fusion_1", 0.0, 100.0), Event("gemm", 100.0, 200.0), Event("fusion_1", 600.0, 400.0)]
    other = [Event("copy", 250.0, 100.0)]
    streams = [Line("Stream #7(Compute)", first), Line("Stream #8(MemcpyD2D)", other)]
    again = Line("XLA Modules", [Event("jit_train", 0.0, 1000.0)])
    data = Data(
        [Plane("/host:CPU", [Line("python", [Event("f", 0.0, 1e9)])]), Plane("/device:GPU:0", [*streams, again])]
    )
    ((spans),) = trace.spans_of_devices(data)
    assert trace.covered_ns(spans) == 350.0 + 400.0
    assert [(o.name, o.seconds * 1e9, o.times) for o in trace.longest(spans)] == [
        ("fusion_1", pytest.approx(500.0), 2),
        ("gemm", pytest.approx(200.0), 1),
        ("copy", pytest.approx(100.0), 1),
    ]
    assert trace.longest(spans)[0].share == pytest.approx(500.0 / 800.0)


def test_a_loop_is_not_charged_for_its_body() -> None:
    op = lambda name: (("hlo_op", name),)  # noqa: E731
    events = [
        Event("while", 0.0, 100.0, op("while.1")),
        Event("x", 10.0, 30.0, op("add.2")),
        Event("no operation", 0, 9),
    ]
    events += [Event("x", 50.0, 40.0, op("add.2"))]
    found = {o.name: o.seconds * 1e9 for o in trace.longest(trace.spans_of_line(events, everything=False))}
    assert found == {"while.1": pytest.approx(30.0), "add.2": pytest.approx(70.0)}


def test_a_trace_of_this_jax_is_read(tmp_path: Path) -> None:
    program = jax.jit(lambda x: jax.lax.fori_loop(0, 20, lambda _, x: jnp.tanh(x @ x) / 3.0, x))
    x = jnp.ones((64, 64))
    program(x).block_until_ready()
    with jax.profiler.trace(str(tmp_path)):
        program(x).block_until_ready()
    found = trace.read(tmp_path)
    assert 0.0 < found.busy <= 1.0
    counts = {operation.name.partition(".")[0]: operation.times for operation in found.operations}
    assert counts.pop("while") == 1
    assert max(counts.values()) == 20  # what stands in the loop's body
    assert sum(operation.share for operation in found.operations) == pytest.approx(1.0)
    origins = trace.origins(program.lower(x).compile().as_text())
    assert "dot_general" in " ".join(origins.get(operation.name, "") for operation in found.operations)
    with pytest.raises(ValueError, match="expected a trace"):
        trace.read(tmp_path / "none")
