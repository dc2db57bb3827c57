"""README and docs: links resolve, commands exist, code compiles, and figures agree with what ships."""

import json
import re
import shlex
from pathlib import Path

import pytest

from cli_helpers import TINY_VALUES
from qrl import api
from qrl.cli.arguments import build_parser
from qrl.config import Config, preset_names

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NAMES = [page.relative_to(ROOT).as_posix() for page in PAGES]
LINK = re.compile(r"\]\(([^)\s]+)\)")


def anchors(page: Path) -> set[str]:
    """GitHub's and mkdocs' anchors of a page's headings, and those that it sets itself."""
    text = page.read_text(encoding="utf-8")
    headings = re.findall(r"^#+ (.+)$", text, flags=re.MULTILINE)
    slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}
    return slugs | set(re.findall(r'<a id="([^"]+)"></a>', text))


def fenced(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)


def commands() -> list[str]:
    found = []
    for page in PAGES:
        for block in fenced(page, "sh"):
            found += [
                line
                for line in block.splitlines()
                if re.match(r"make\b|.*\bqrl (train|evaluate|export|view|sweep|identify)", line)
            ]
    return sorted(set(found))


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_links_lead_somewhere(page: Path) -> None:
    for target in LINK.findall(page.read_text(encoding="utf-8")):
        if re.match(r"https?:", target):
            continue
        file, _, anchor = target.partition("#")
        path = (page.parent / file).resolve() if file else page
        assert path.exists(), target
        if anchor and path.suffix == ".md":
            assert anchor in anchors(path), target


def test_pages_are_all_in_the_navigation() -> None:
    navigation = re.findall(r": ([\w/]+\.md)$", (ROOT / "mkdocs.yml").read_text(), flags=re.MULTILINE)
    assert sorted(navigation) == sorted(page.name for page in PAGES if page.parent.name == "docs")


@pytest.mark.parametrize("line", commands())
def test_commands_exist(line: str) -> None:
    """The target is in the Makefile, and the parser takes the flags."""
    words = shlex.split(line, comments=True)
    parser = build_parser()
    if words[0] == "make":
        variables = dict(word.split("=", 1) for word in words[1:] if "=" in word)
        targets = [word for word in words[1:] if "=" not in word]
        makefile = (ROOT / "Makefile").read_text()
        for target in targets:
            assert re.search(rf"^(\$\(or )?{target}\)?:", makefile, flags=re.MULTILINE), target
        known = {
            "TASK",
            "VEHICLE",
            "SEED",
            "SEEDS",
            "FIRST",
            "OUT",
            "RESUME",
            "CONFIG",
            "ARGS",
            "RUN",
            "GRID",
            "FAST",
            "NAME",
            "UNCERTAINTY",
            "INIT",
            "LOG",
            "REFERENCE",
            "PYTHON",
        }
        assert set(variables) <= known
        command = targets[0] if targets else ""
        subject = variables.get({"train": "TASK", "sweep": "GRID"}.get(command, "RUN"), "x")
        words = [command, subject, *shlex.split(variables.get("ARGS", ""))]
        if command == "identify":
            words = [command, *variables["LOG"].split(), "--vehicle", variables["VEHICLE"], *words[2:]]
    else:
        words = words[next(i for i, word in enumerate(words) if word.endswith("qrl")) + 1 :]
    if words[0] in ("train", "evaluate", "export", "view", "sweep", "identify"):
        parser.parse_args(words)


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_python_compiles(page: Path) -> None:
    for block in fenced(page, "python"):
        compile(block, page.name, "exec")


@pytest.mark.parametrize("page", PAGES, ids=NAMES)
def test_json_is_json(page: Path) -> None:
    for block in fenced(page, "json"):
        json.loads(block)


def test_make_docs_checks_links() -> None:
    """mkdocs in strict mode fails on a warning only where warnings are shown."""
    recipe = re.search(r"^docs:.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    assert recipe
    assert not re.search(r"mkdocs build.*(--quiet|-q\b)", recipe[1])
    assert "\nstrict: true\n" in (ROOT / "mkdocs.yml").read_text()


def test_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_results_are_of_the_presets_that_ship() -> None:
    """docs/results.json has two rows for hover and circle, of as many steps as their presets; README shows them."""
    from experiments import results

    found = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
    assert min(found["seeds"]) >= 100
    methods = {(row["task"], row["method"]) for row in found["rows"]}
    assert methods == {(row.task, row.method) for row in results.ROWS}
    for row in results.ROWS:
        config = Config.preset(row.task).model_copy(update=row.flags)
        measured = next(r for r in found["rows"] if (r["task"], r["method"]) == (row.task, row.method))
        assert measured["steps"] == config.num_unrolls * config.steps_per_unroll
    assert results.main(["--check", str(ROOT / "README.md")]) == 0


def test_the_readme_states_measured_times() -> None:
    """The seconds of `qrl train` are those of docs/results.json, of the presets as they ship."""
    found = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
    measured = {row["command"]: row["command_seconds"]["worst"] for row in found["rows"]}
    text = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    stated = re.findall(r"`qrl train (\w+)` took (\d+) s|`qrl train (\w+)` (\d+) s", text)
    times = {a or b: int(s or t) for a, s, b, t in stated}
    assert times == {name: round(measured[f"qrl train {name} --seed 100 --seeds 1"]) for name in ("hover", "circle")}


def test_the_gallery_is_of_the_presets_that_ship_or_says_so() -> None:
    """Each preset's run has as many steps as its preset, or a note at the head says that the page is older."""
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    runs = re.findall(r"`qrl train (\w+) --seed \d+ --seeds 1(?: --preset (\w+))?`,\s([\d,]+) steps", page)
    assert sorted(preset or task for task, preset, _ in runs) == sorted(
        [f"{task}{suffix}" for task in ("pendulum", "hover", "circle") for suffix in ("", "_ppo")]
    )
    stale = []
    for task, preset, steps in runs:
        config = Config.preset(preset or task)
        if int(steps.replace(",", "")) != config.num_unrolls * config.steps_per_unroll:
            stale.append(preset or task)
    head = page[: page.index("\n## ")]
    assert not stale or "**Figures of the first version**" in head, stale


def test_presets_named_in_pages_exist() -> None:
    for page in PAGES:
        for name in re.findall(r"--preset (\w+)", page.read_text(encoding="utf-8")):
            assert name in preset_names(), (page.name, name)


@pytest.fixture
def tiny(little_export: None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """In an empty folder; what is trained is tiny, whatever the preset."""
    train = api.train
    monkeypatch.setattr(api, "train", lambda *words, **flags: train(*words, **(TINY_VALUES | flags)))
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("tiny")
def test_the_notebook_runs(tmp_path: Path) -> None:
    """All code cells, in order, in this process."""
    notebook = json.loads((ROOT / "docs" / "first_flight.ipynb").read_text(encoding="utf-8"))
    namespace: dict[str, object] = {}
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "first_flight.ipynb", "exec"), namespace)
    assert (tmp_path / "runs" / "notebook" / "export" / "qrl_pendulum.c").exists()


@pytest.mark.usefixtures("tiny")
def test_the_readme_snippet_runs(tmp_path: Path) -> None:
    """All python blocks of README, in order, in this process."""
    namespace: dict[str, object] = {}
    for block in fenced(ROOT / "README.md", "python"):
        exec(compile(block, "README.md", "exec"), namespace)
    assert (tmp_path / "runs" / "first" / "export" / "manifest.json").exists()
