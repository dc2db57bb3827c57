"""The files that a firmware author gets: complete, true to the manifest, and safe whatever a run is called."""

import csv
import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import policies
from cross_targets import need
from policies import FLAT, HOVER, NAME, ODD, PENDULUM, PROVENANCE
from qrl.export import emit, targets, vectors
from qrl.export.policy import Policy
from qrl.export.targets import STRICT

HEADER, SOURCE = f"{NAME}.h", f"{NAME}.c"
EXAMPLE = "examples/bare_metal"
HOSTILE = {
    "ends the comment": 'a */ int x = *"/ ; /* b',
    "backslash for slash": "a *\\ int x; b",
    "opens a comment": "a /\\* b /* c",
    "quotes": "\"quoted\" 'so' `so`",
    "JSON": '", "name": "evil", "x": ["',
    "newlines": "one\ntwo\r\nthree\n#error four",
    "continued": "what\\",
    "trigraph": "what??/",
    "not ASCII": "Höhenflug ≤ 2 m, 悬停, 🚁",
    "right to left": "a \u202e b \u2067 c",
    "placeholder": "@tables@ @nobody@ %s %d \\g<0>",
    "control": "a\tb\x0bc\x0cd\x00e\u2028f",
}


def files(sizes: tuple[int, ...] = HOVER, activation: str = "relu", policy: Policy | None = None) -> dict[str, str]:
    policy, kernel = policy or policies.policy(sizes, activation), policies.kernel(sizes, activation)
    return emit.files(policy, kernel, vectors.golden(policy, kernel), NAME)


def named(**changes: str) -> Policy:
    """The smallest policy, of another provenance."""
    return replace(policies.policy(ODD), provenance=replace(PROVENANCE, **changes))


def compiled(folder: Path, *flags: str, sources: tuple[str, ...] = (SOURCE,), output: str = "object.o") -> None:
    compiler = targets.host_compiler()
    assert compiler
    command = [compiler, *flags, "-I", ".", *sources, "-o", output]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr


def run(*command: str, cwd: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name not in ("CFLAGS", "MAKEFLAGS", "CC")}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + done.stdout
    return done.stdout


@pytest.mark.parametrize("sizes", [HOVER, PENDULUM, ODD, FLAT], ids=str)
def test_nothing_is_left_to_fill_in(sizes: tuple[int, ...]) -> None:
    """Nor does a file say when or where it was made: the same policy gives the same files."""
    emitted = files(sizes)
    assert set(emitted) == policies.emitted_files()
    for name, text in emitted.items():
        assert not re.search(r"@\w+@", text), name
        assert not re.search(r"(^|[\s\"'(])/(home|tmp|work|root|usr)\b", text), name
        assert not re.search(r"\b20\d\d-\d\d|\d\d:\d\d:\d\d|\b(Jan|Nov|Dec)\b", text), name
        assert "\r" not in text
        assert text.endswith("\n")
    assert files(sizes) == emitted


# -- the manifest --------------------------------------------------------------------------------------------


def strict_json(text: str) -> dict:
    def refuse(what: str) -> float:
        raise AssertionError(f"{what} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_the_manifest_keeps_its_contract() -> None:
    """Its keys, which other tools read (docs/deploy.md)."""
    found = strict_json(files()["manifest.json"])
    kernel = policies.kernel()
    assert list(found)[:6] == ["format", "name", "task", "vehicle", "run", "commit"]
    for key, wanted in {
        "format": 2,
        "name": "hover",
        "task": "hover",
        "run": "made-up",
        "commit": "0123456789ab",
        "control_period_s": 0.01,
    }.items():
        assert found[key] == wanted
    names = "r11 r12 r13 r21 r22 r23 r31 r32 r33 px py pz vx vy vz wx wy wz"
    assert " ".join(port["name"] for port in found["obs"]) == names
    assert [port["unit"] for port in found["obs"]] == ["1"] * 9 + ["m"] * 3 + ["m/s"] * 3 + ["rad/s"] * 3
    for i, port in enumerate(found["obs"]):
        assert set(port) == {"name", "unit", "frame", "range", "steps", "lsb"}
        assert port["steps"] == [kernel.obs_min[i], kernel.obs_max[i]]
        assert port["range"] == [pytest.approx(steps * port["lsb"]) for steps in port["steps"]]
    assert [(port["name"], port["unit"]) for port in found["act"]] == [(f"f{i}", "N") for i in range(1, 5)]
    a = 0.07425
    assert [port["position_m"] for port in found["act"]] == [[a, a], [-a, a], [-a, -a], [a, -a]]
    assert [port["spin"] for port in found["act"]] == [1, -1, 1, -1]
    for port in found["act"]:
        assert set(port) == {"name", "unit", "frame", "position_m", "spin", "range", "lsb", "safe"}
        assert port["range"] == [0.0, pytest.approx(0.667 * 9.81 / 4 + 6.0, rel=1e-3)]
        assert port["safe"] == pytest.approx(1.636, abs=1e-3)


def test_the_manifest_has_the_axis_of_a_tilted_motor() -> None:
    policy, axis = policies.policy(), (0.0, 0.1, 0.995)
    tilted = replace(policy, actions=(replace(policy.actions[0], axis=axis), *policy.actions[1:]))
    first, second, *_ = strict_json(files(policy=tilted)["manifest.json"])["act"]
    assert (first["axis"], "axis" in second) == (list(axis), False)


def test_the_pendulums_manifest_has_no_motors() -> None:
    found = strict_json(files(PENDULUM)["manifest.json"])
    assert [(port["name"], port["unit"]) for port in found["obs"]] == [
        ("cos_theta", "1"),
        ("sin_theta", "1"),
        ("theta_dot", "rad/s"),
    ]
    (torque,) = found["act"]
    assert set(torque) == {"name", "unit", "frame", "range", "lsb", "safe"}
    assert (torque["name"], torque["unit"], torque["safe"]) == ("torque", "N m", 0.0)
    assert torque["range"] == [pytest.approx(-2.0), pytest.approx(2.0)]
    assert found["control_period_s"] == 0.05


def test_the_manifests_steps_are_the_kernels() -> None:
    """Who scales by the manifest alone gets what the float entry gives."""
    policy, kernel = policies.policy(), policies.kernel()
    found = strict_json(files()["manifest.json"])
    obs_lsb, act_lsb = (np.array([port["lsb"] for port in found[side]]) for side in ("obs", "act"))
    steps = np.round(policy.calibration[:300] / obs_lsb).astype(np.int16)
    action = policies.step_i16(kernel, steps)[1] * act_lsb
    # The 16 bits that the float entry reads of a significand may be a step apart.
    low, high = policy.limits
    np.testing.assert_allclose(
        action / (high - low), policies.step(kernel, policy.calibration[:300])[1] / (high - low), atol=2e-3
    )


# -- the header ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [HOVER, PENDULUM], ids=str)
def test_the_header_says_what_everything_is(sizes: tuple[int, ...]) -> None:
    policy, header = policies.policy(sizes), files(sizes)[HEADER]
    comment = header[: header.index("*/")]
    for fact in ("hover", PROVENANCE.description, "Run made-up", "seed 3", "1,234,567", "commit 0123456789ab"):
        assert fact in comment
    assert f"every {policy.control_period_s:g} s" in comment
    for side, ports in (("OBS", policy.observations), ("ACT", policy.actions)):
        assert f"#define HOVER_{side}_SIZE {len(ports)}\n" in header
        for i, port in enumerate(ports):
            assert re.search(rf"\* +{i} +{port.name} +{re.escape(port.unit)} +-?[\d.]+ \.\. .*{port.frame}", comment)
            assert f"HOVER_{side}_{port.name.upper()} = {i}" in header
    assert f"#define HOVER_PERIOD_US {round(policy.control_period_s * 1e6)}\n" in header


def test_the_header_says_where_each_motor_is_and_how_it_turns() -> None:
    header = files()[HEADER]
    lines = [line for line in header.splitlines() if "thrust" in line]
    for line, (x, y, spin) in zip(lines, [("+", "+", 1), ("-", "+", -1), ("-", "-", 1), ("+", "-", -1)], strict=True):
        assert f"x {x}0.07425 m, y {y}0.07425 m" in line
        sense = "spin +1: reaction torque positive about body z, so it turns clockwise"
        assert (sense if spin > 0 else "spin -1: counter-clockwise") in line
        assert "safe 1.636" in line


def test_the_headers_steps_are_the_kernels() -> None:
    header, kernel = files()[HEADER], policies.kernel()
    for side, lsb in (("OBS", kernel.lsb), ("ACT", kernel.act_lsb)):
        values = re.search(rf"#define HOVER_{side}_LSB (.*)", header)
        assert values
        found = np.array([float(value.rstrip("Ff")) for value in values[1].split(",")], np.float32)
        np.testing.assert_array_equal(found, lsb.astype(np.float32))


# -- golden vectors ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [HOVER, PENDULUM, ODD, FLAT], ids=str)
def test_golden_vectors_replay(sizes: tuple[int, ...]) -> None:
    policy, kernel = policies.policy(sizes), policies.kernel(sizes)
    header, *rows = csv.reader(files(sizes)["golden.csv"].splitlines())
    names, acts = [port.name for port in policy.observations], [port.name for port in policy.actions]
    steps = [f"{name}_lsb" for name in names]
    assert header == [*names, *steps, "status", "status_i16", *(f"{name}_lsb" for name in acts)]
    assert len(rows) == 256
    n = len(names)
    obs = np.array([[float(cell) for cell in row[:n]] for row in rows], np.float32)
    obs_i16, answers = (
        np.array([[int(cell) for cell in row[part]] for row in rows]) for part in (slice(n, 2 * n), slice(2 * n, None))
    )
    status, action = policies.step(kernel, obs)
    status_i16, action_i16 = policies.step_i16(kernel, obs_i16.astype(np.int16))
    np.testing.assert_array_equal(answers[:, 0], status)
    np.testing.assert_array_equal(answers[:, 1], status_i16)
    np.testing.assert_array_equal(answers[:, 2:], action_i16)
    np.testing.assert_array_equal(answers[:, 2:].astype(np.float32) * kernel.act_lsb, action)
    assert set(status) == {0, 1}
    assert len(np.unique(answers[:, 2:], axis=0)) > 50


# -- whatever a run is called --------------------------------------------------------------------------------


@pytest.mark.usefixtures("host")
@pytest.mark.parametrize("text", HOSTILE.values(), ids=HOSTILE.keys())
def test_no_name_breaks_a_file(text: str, tmp_path: Path) -> None:
    policy = named(run=text, task=text, description=text, commit=text)
    folder = policies.emitted(tmp_path, policy, policies.kernel(ODD)).parent
    compiled(folder, *STRICT, "-c")
    compiled(folder, *STRICT, sources=(f"{EXAMPLE}/main.c", SOURCE), output="example")
    manifest = strict_json((folder / "manifest.json").read_text())
    assert (manifest["run"], manifest["task"], manifest["commit"]) == (text, text, text)
    library = strict_json((folder / "library.json").read_text())
    assert set(library) == set(strict_json(files(ODD)["library.json"]))
    assert library["name"] == "hover"
    properties, plain = ((folder / "library.properties").read_bytes(), files(ODD)["library.properties"].encode())
    keys = [[line.split(b"=")[0] for line in text.splitlines()] for text in (properties, plain)]
    assert keys[0] == keys[1]


@pytest.mark.usefixtures("host")
def test_a_name_that_is_not_unicode_is_emitted(tmp_path: Path) -> None:
    """A folder's name may be any bytes; Python hands them on as lone surrogates."""
    policy = named(run=os.fsdecode(b"caf\xe9"))
    compiled(policies.emitted(tmp_path, policy, policies.kernel(ODD)).parent, *STRICT, "-c")


# -- it builds -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[tuple[int, ...], str], Path]:
    need([] if targets.host_compiler() else ["a C compiler"])
    return {
        (sizes, activation): policies.emitted(
            tmp_path_factory.mktemp("export"), policies.policy(sizes, activation), policies.kernel(sizes, activation)
        ).parent
        for sizes in (HOVER, PENDULUM, ODD, FLAT)
        for activation in ("relu", "tanh")
    }


Exported = dict[tuple[tuple[int, ...], str], Path]


@pytest.mark.parametrize("dialect", ["-std=c99", "-std=c11", "-std=gnu17"])
def test_it_compiles_without_a_warning(exported: Exported, dialect: str) -> None:
    for folder in exported.values():
        compiled(folder, *STRICT, dialect, "-Wundef", "-Wcast-qual", "-Wwrite-strings", "-c")


def test_it_needs_no_library_and_keeps_no_state(exported: Exported) -> None:
    """No symbol but its own entries, and nothing that is written."""
    need([] if shutil.which("nm") else ["nm"])
    for folder in exported.values():
        compiled(folder, "-std=c99", "-O2", "-fno-stack-protector", "-c")
        symbols = [line.split()[-2:] for line in run("nm", "object.o", cwd=folder).splitlines()]
        assert {name for kind, name in symbols if kind == "T"} == {
            *("hover_reset", "hover_step", "hover_step_i16", "hover_selftest"),
        }
        outside = {name for kind, name in symbols if kind == "U"}
        assert outside <= {"memset", "memcpy", "_GLOBAL_OFFSET_TABLE_"}
        assert not {kind for kind, _ in symbols} & set("BbCDGgSs")  # of variables


def test_the_example_builds_and_runs(exported: Exported, tmp_path: Path) -> None:
    """By its Makefile, copied elsewhere, for both a vehicle and an action without a name of its own."""
    need([tool for tool in ("make", "cc") if not shutil.which(tool)])
    for sizes, activation in ((HOVER, "relu"), (ODD, "tanh")):
        policy, kernel = policies.policy(sizes, activation), policies.kernel(sizes, activation)
        folder = shutil.copytree(exported[sizes, activation], tmp_path / f"{sizes[0]}")
        said = run("make", "-s", cwd=folder / EXAMPLE)
        names, values = said.strip().split(": ")
        assert names.split() == [port.name for port in policy.actions]
        wanted = policies.step(kernel, vectors.golden(policy, kernel).obs[:1])[1][0]
        np.testing.assert_allclose([float(value) for value in values.split()], wanted, atol=6e-5)
        run("make", "-s", "clean", cwd=folder / EXAMPLE)
        assert {
            str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()
        } <= policies.emitted_files() | {"object.o"}


def test_the_example_says_when_its_self_test_fails(exported: Exported, tmp_path: Path) -> None:
    need([tool for tool in ("make", "cc") if not shutil.which(tool)])
    folder = shutil.copytree(exported[ODD, "relu"], tmp_path / "export")
    source = (folder / SOURCE).read_text()
    (folder / SOURCE).write_text(source.replace("act_safe[HOVER_ACT_SIZE] = {", "act_safe[] = {1.0F +", 1))
    assert (folder / SOURCE).read_text() != source
    run("make", "-s", "policy", cwd=folder / EXAMPLE)
    run("./policy", cwd=folder / EXAMPLE)  # the self-test asks for the same safe action
    bias = re.search(r"\bB4\((-?\d+),", source)
    assert bias
    (folder / SOURCE).write_text(source.replace(bias[0], f"B4({int(bias[1]) + 2**20},", 1))
    run("make", "-s", "policy", cwd=folder / EXAMPLE)
    done = subprocess.run(["./policy"], cwd=folder / EXAMPLE, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stdout.startswith("self-test 1 failed")


@pytest.mark.parametrize("name", [NAME, "policy", "all"])
def test_the_example_builds_with_cmake(name: str, tmp_path: Path) -> None:
    """Whatever CMake's own targets and those of other examples are called."""
    if not shutil.which("cmake"):
        pytest.skip("missing here: cmake")
    kernel = policies.kernel(ODD, "tanh")
    folder = policies.emitted(tmp_path / "export", policies.policy(ODD, "tanh"), kernel, name=name).parent
    run("cmake", "-S", str(folder / EXAMPLE), "-B", str(tmp_path / "build"), cwd=tmp_path)
    run("cmake", "--build", str(tmp_path / "build"), cwd=tmp_path)
    assert run(f"./{name}_example", cwd=tmp_path / "build").startswith("a0 a1: ")


def test_cpp_may_call_it(exported: Exported, tmp_path: Path) -> None:
    if not shutil.which("g++"):
        pytest.skip("missing here: g++")
    folder = shutil.copytree(exported[ODD, "relu"], tmp_path / "export")
    compiled(folder, "-std=c99", "-O2", "-c")
    (folder / "main.cpp").write_text(
        '#include "hover.h"\n'
        "int main() {\n"
        "    static const float obs_lsb[] = {HOVER_OBS_LSB}, act_lsb[] = {HOVER_ACT_LSB};\n"
        "    float obs[HOVER_OBS_SIZE] = {}, act[HOVER_ACT_SIZE];\n"
        "    int16_t steps[HOVER_OBS_SIZE] = {}, act_steps[HOVER_ACT_SIZE];\n"
        "    hover_state state, state_i16;\n"
        "    hover_reset(&state);\n"
        "    hover_reset(&state_i16);\n"
        "    hover_step(&state, obs, act);\n"
        "    hover_step_i16(&state_i16, steps, act_steps);\n"
        "    for (int i = 0; i < HOVER_ACT_SIZE; ++i) {\n"
        "        if (act[i] != static_cast<float>(act_steps[i]) * act_lsb[i]) return 2;\n"
        "    }\n"
        "    return obs_lsb[HOVER_OBS_O4] > 0 ? hover_selftest() : 3;\n"
        "}\n"
    )
    flags = ("-std=c++11", "-pedantic", "-Wall", "-Wextra", "-Werror")
    run("g++", *flags, "-x", "c++", "main.cpp", "-x", "none", "object.o", "-o", "main", cwd=folder)
    run("./main", cwd=folder)
