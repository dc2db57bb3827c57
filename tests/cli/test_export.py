"""`qrl export` as a user meets it: the whole folder or nothing, and one clear line for every run that has no policy."""

import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.fast import Fast

import policies
from cli_helpers import complaint, qrl, untrained
from qrl import tasks
from qrl.cli import export
from qrl.evaluation import calibration
from qrl.evaluation.trained_run import TrainedRun, inputs_in_si, vehicle_name
from qrl.export.kernel import AccumulatorOverflow
from qrl.export.policy import Memory, Policy
from qrl.export.quantize import UnsupportedNetwork
from qrl.export.report import with_warnings
from qrl.export.targets import VerificationFailed
from qrl_envs.task import QuadrotorTask
from qrl_envs.vehicle import shipped_vehicles

LEAST = ("--starts", "8", "--vectors", "500")


def exported_files(name: str) -> set[str]:
    return policies.emitted_files(name) | {"report.md", f"{name}.onnx", f"{name}.npz"}


FILES = exported_files("qrl_pendulum")


pytestmark = pytest.mark.usefixtures("little_export")


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A copy of the tiny run."""
    return Path(shutil.copytree(trained, tmp_path / "pendulum", ignore=shutil.ignore_patterns("export")))


@pytest.fixture(scope="module")
def policy(trained: Path) -> Policy:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(calibration, "STARTS", 10)
        return TrainedRun.load(trained).policy()


@pytest.fixture
def calibrated(policy: Policy, monkeypatch: pytest.MonkeyPatch) -> None:
    """For exports of the tiny run whose calibration is not what is tested: its flights take longer than the rest."""
    monkeypatch.setattr(TrainedRun, "policy", lambda _: policy)


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_export_is_whole_and_the_same_again(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """It replaces what was there, file by file."""
    assert qrl("export", run, *LEAST) == 0
    said = capsys.readouterr().out
    assert "skipped Cortex-M and its costs: the cross compiler not found" in said
    assert f"{run}/export/qrl_pendulum.c" in said
    first = contents(run / "export")
    assert set(first) == FILES
    manifest = json.loads(first["manifest.json"])
    assert (manifest["task"], manifest["run"], manifest["env_steps"]) == ("pendulum", "pendulum", 400)
    assert manifest["commit"] == json.loads((run / "config.json").read_text())["versions"]["commit"]
    assert [port["name"] for port in manifest["obs"]] == ["cos_theta", "sin_theta", "theta_dot"]
    assert manifest["network"] == [3, 4, 1]
    for name, text in first.items():
        assert str(run.parent).encode() not in text, name
    (run / "export" / "mine.txt").write_text("from an earlier export")
    (run / "export" / "report.md").write_text("old")
    assert qrl("export", run, *LEAST) == 0
    assert contents(run / "export") == first
    assert {path.name for path in run.iterdir()} - {"export"} <= {
        *("config.json", "metrics.csv", "checkpoints", "tensorboard", "summary.json"),
        *("lock", "learning_curve.png", "flight.png", "evaluation.json", "evaluation.png"),
    }


@pytest.mark.usefixtures("calibrated")
@pytest.mark.parametrize("raised", [VerificationFailed("M0: a bit differs"), AccumulatorOverflow("layer 0: past 2^31")])
def test_a_verification_that_fails_leaves_what_was_there(
    raised: Exception, run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 1, one line; nothing where nothing was."""

    def fail(*_: object) -> None:
        raise raised

    monkeypatch.setattr(export, "verify" if isinstance(raised, VerificationFailed) else "quantize", fail)
    before = contents(run)
    for had in (False, True):
        if had:
            (run / "export").mkdir()
            (run / "export" / "qrl_pendulum.c").write_text("earlier")
            before = contents(run)
        capsys.readouterr()
        assert qrl("export", run, *LEAST) == 1
        assert capsys.readouterr().err == f"qrl: {raised}\n"
        assert contents(run) == before
        assert (run / "export").exists() == had
        assert not list(run.glob(".*"))


def test_an_adapters_readme_begins_with_what_failed() -> None:
    page = "# hover on a vehicle\n\nCopy it.\n"
    assert with_warnings(page, []) == page
    title, _, first, *_, last = with_warnings(page, ["> **Warning: failed: …**"]).splitlines()
    assert (title, first, last) == ("# hover on a vehicle", "> **Warning: failed: …**", "Copy it.")


@pytest.mark.usefixtures("calibrated")
def test_failed_gates_are_a_warning(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An untrained policy: the first lines of the report, and exit code 0."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qrl.export.report.Gate.passed", property(lambda self: not self.name.startswith("RMS action")))
        assert qrl("export", run, *LEAST) == 0
    title, empty, warning, *_ = (run / "export" / "report.md").read_text().splitlines()
    assert title.startswith("# pendulum: 3-4-1")
    assert not empty
    assert warning.startswith("> **Warning: failed: RMS action error: ")
    assert "FAILED" in capsys.readouterr().out


def test_without_a_compiler_it_exports_unverified(
    run: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(calibration, "STARTS", 10)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert qrl("export", run, *LEAST) == 0
    said, report = capsys.readouterr().out, (run / "export" / "report.md").read_text()
    for skipped in (
        "host: C compiler (cc) not found",
        "Cortex-M and its costs: arm-none-eabi-gcc, arm-none-eabi-size, qemu-system-arm not found",
    ):
        assert f"skipped {skipped}\n" in said
        assert f"- Skipped {skipped}.\n" in report
    assert "verified" not in said
    assert "Verified" not in report


def test_a_foreign_environment_exports(
    trained_foreign: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One of Brax's own, the one that compiles at once: all that is known of its ports is their order."""
    run = shutil.copytree(trained_foreign, tmp_path / "run")
    assert "'fast' does not define `dt`" in complaint(capsys, "export", run, *LEAST)
    monkeypatch.setattr(Fast, "dt", 0.02, raising=False)  # as all but this one do
    assert qrl("export", run, *LEAST) == 0
    manifest = json.loads((run / "export" / "manifest.json").read_text())
    assert [port["name"] for port in manifest["obs"]] == ["o0", "o1"]
    assert [(port["name"], port["unit"]) for port in manifest["act"]] == [("a0", "?")]
    assert manifest["control_period_s"] == 0.02
    assert set(contents(run / "export")) == exported_files("qrl_fast")


def test_a_policy_with_memory_is_the_one_that_was_trained(run: Path) -> None:
    """As if the last observation of the pendulum were the previous action a: the policy has it in N m."""
    loaded = TrainedRun.load(run)
    observations, actions = loaded._specs()
    loaded._specs = lambda: (observations[:2], actions)
    policy = loaded.float_policy(Memory(previous_action=True, integral=None))
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (50, 3)).astype(np.float32)
    inputs = inputs_in_si(policy, seen)
    np.testing.assert_allclose(inputs, seen * [1.0, 1.0, 2.0])  # the greatest torque is 2 N m
    wanted = 2.0 * np.clip(np.asarray(loaded.act((), seen)[1]), -1.0, 1.0)
    assert np.ptp(wanted) > 1e-3
    np.testing.assert_allclose(policy(inputs), wanted, atol=1e-5)
    memory, action = policy.step(inputs[:, 2:], inputs[:, :2])
    np.testing.assert_allclose(action, wanted, atol=1e-5)
    np.testing.assert_array_equal(memory, action)


@pytest.mark.parametrize(
    ("task", "words", "inputs"),
    [
        ("circle", ["--vehicle", "crazyflie"], 12 + 4 + 5),
        ("any", [], 15 + 9 + 4 + 3),
        ("raptor", ["--policy-hidden-layer-sizes", "[16]"], 18 + 4),
    ],
)
def test_a_policy_with_all_that_a_task_gives_it_exports(
    task: str, words: list[str], inputs: int, tmp_path: Path
) -> None:
    """With all memory, in the body frame or with limits on what it is given: the policy is the one of the checkpoint.
    With a preview, a recurrent unit, and actions that are rotor speeds, the kernel is verified too: circle's integral
    and forces are no other code from there on.
    """
    run = untrained(tmp_path / "run", task, *words)
    loaded = TrainedRun.load(run)
    policy = loaded.float_policy()
    assert (policy.body_frame is None) == (task == "raptor")
    if policy.body_frame:
        assert policy.body_frame.last
        assert policy.memory
        assert policy.memory.integral
        assert policy.memory.integral.circle_m == (1.0 if task == "circle" else None)
    assert len(policy.layers[0][0]) == inputs
    said = {(port.unit, port.quantity) for port in policy.actions}
    assert said == ({("N", None)} if task == "circle" else {("1", "rotor speed fraction")})
    env: Any = loaded.env
    seen = np.array(jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 20)).obs)
    assert np.abs(seen[:, 9:12]).max() > 0.5
    remembered = slice(len(policy.observations), env.policy_observation_size)
    seen[:, remembered] = np.random.default_rng(0).uniform(-0.5, 0.5, seen[:, remembered].shape)
    units = policy.memory.units if policy.memory else 0
    assert units
    h = np.random.default_rng(1).uniform(-0.9, 0.9, (20, units))
    after, action = jax.jit(loaded.act)(jnp.asarray(h), seen)
    wanted = policy.to_si(np.asarray(action))
    assert np.ptp(wanted, axis=0).min() > 1e-4
    found_h, found = policy.respond(np.concatenate([inputs_in_si(policy, seen), h], axis=1))
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    np.testing.assert_allclose(found_h, after, atol=1e-5)
    if task == "circle":
        return
    assert qrl("export", run, *LEAST) == 0
    manifest = json.loads((run / "export" / "manifest.json").read_text())
    assert manifest["network"][0] == inputs
    if task == "any":  # calibrated on the motion of training, not on the eight that is evaluated: there 1.3 m/s
        assert max(port["range"][1] for port in manifest["obs"] if "ahead_s" in port) > 1.8
        assert manifest["memory"]["integral"]["circle_m"] is None
    assert {port["quantity"] for port in manifest["act"]} == {"rotor speed fraction"}
    assert {path.name for path in (run / "export" / "crazyflie" / "src").iterdir()} > {manifest["name"] + ".c"}
    assert "`crazyflie/` is an app" in (run / "export" / "report.md").read_text()
    assert (run / "export" / "px4" / "policy.tar").exists() == (task == "raptor")
    assert ("No `px4/policy.tar`: the inputs" in (run / "export" / "report.md").read_text()) == (task != "raptor")
    assert (run / "export" / "px4" / "module" / "README.md").read_text().splitlines()[2].startswith("> **Warning: ")


@pytest.mark.parametrize("name", shipped_vehicles())
def test_a_shipped_vehicle_is_named(name: str) -> None:
    """As the task that a run records has it, under whatever name that is."""
    task = tasks.spec(tasks.task_record("hover", {"vehicle": name}))
    assert isinstance(task, QuadrotorTask)
    assert vehicle_name(task) == name
    heavier = task.model_copy(
        update={"vehicle": task.vehicle.model_copy(update={"mass_kg": 1.01 * task.vehicle.mass_kg})}
    )
    assert vehicle_name(heavier) is None


# -- refused -------------------------------------------------------------------------------------------------


def altered(run: Path, **changes: object) -> None:
    config = json.loads((run / "config.json").read_text())
    learner = changes.pop("learner", {})
    (run / "config.json").write_text(json.dumps(config | changes | {"learner": config["learner"] | learner}))


def truncated(run: Path) -> None:
    """Every file of the last checkpoint's arrays loses its second half."""
    for path in (run / "checkpoints" / "400").rglob("*"):
        if path.is_file() and path.stat().st_size > 300:
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


BROKEN = {
    "no run": (lambda run: (run / "config.json").unlink(), "not a run folder"),
    "no checkpoints": (lambda run: shutil.rmtree(run / "checkpoints"), "no checkpoint"),
    "no checkpoint": (
        lambda run: [shutil.rmtree(path) for path in (run / "checkpoints").iterdir() if path.is_dir()],
        "no checkpoint",
    ),
    "half a checkpoint": (truncated, "checkpoints/400/"),
    "another format": (lambda run: altered(run, format=2), "key 'format'"),
    "not JSON": (lambda run: (run / "config.json").write_text('{"format": 1,'), "config.json"),
    "several seeds": (lambda run: altered(run, seeds=3), "holds 3 seeds; name one of them, such as RUN="),
    "another network": (
        lambda run: altered(run, learner={"policy_hidden_layer_sizes": [8]}),
        "of another run than config.json",
    ),
    "one layer more": (
        lambda run: altered(run, learner={"policy_hidden_layer_sizes": [4, 4]}),
        "of another run than config.json",
    ),
    "an activation": (lambda run: altered(run, learner={"activation": "gelu"}), "key 'learner.activation'"),
}


@pytest.mark.parametrize("damage", BROKEN)
def test_what_cannot_be_exported_is_one_clear_line(damage: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Exit code 2; nothing is left behind."""
    change, says = BROKEN[damage]
    change(run)
    before = contents(run)
    line = complaint(capsys, "export", run, *LEAST)
    assert says in line
    assert str(run) in line
    assert contents(run) == before
    assert not list(run.glob(".*"))


@pytest.mark.usefixtures("calibrated")
def test_a_network_without_a_form_is_refused(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise UnsupportedNetwork("layer 1: a weight is not finite")

    monkeypatch.setattr(export, "quantize", fail)
    assert complaint(capsys, "export", run, *LEAST) == f"qrl: {run}: layer 1: a weight is not finite\n"
    assert not (run / "export").exists()


@pytest.mark.parametrize("name", ["9lives", "my-policy", "", "a b", "stdint", "../x", "é", "x" * 65])
def test_a_name_that_c_cannot_have_is_refused(name: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = complaint(capsys, "export", run, *LEAST, "--name", name)
    assert line.startswith(f"qrl: --name '{name}': expected a C identifier")
    assert not (run / "export").exists()


@pytest.mark.usefixtures("calibrated")
def test_an_export_has_the_name_that_is_given(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And an export of another name replaces it whole."""
    assert qrl("export", run, *LEAST) == 0
    assert qrl("export", run, *LEAST, "--name", "swing_up") == 0
    assert f"{run}/export/swing_up.c" in capsys.readouterr().out
    assert set(contents(run / "export")) == exported_files("swing_up")
    manifest = json.loads((run / "export" / "manifest.json").read_text())
    assert (manifest["format"], manifest["name"], manifest["state_bytes"]) == (2, "swing_up", 1)
    assert (manifest["vehicle"], manifest["memory"]) == (None, None)


@pytest.mark.parametrize("flag", ["--starts", "--vectors"])
def test_wrong_counts_are_refused(flag: str, run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert flag in complaint(capsys, "export", run, flag, "few")
