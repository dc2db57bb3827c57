"""The gallery: its page shows what its runs found, and every picture that it links is there."""

import re
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from experiments.figures import make as figures
from experiments.figures import runs as figure_runs
from experiments.figures.captions import CONFIRMED, NOT, Caption
from experiments.figures.runs import RunSpec
from experiments.gallery import browser
from experiments.gallery import make as gallery
from qrl.runs import files

CAPTIONS = {
    name: Caption(f"Of {name}", "Shows it.", f"claims {name}", [f"- {name} is 3."], "By a rule.", verdict)
    for name, verdict in zip(figures.FIGURES, [CONFIRMED, NOT] * 3, strict=True)
}
FOUND: dict[str, Any] = {
    "env_steps": 1_234_000,
    "starts": 1000,
    "return_mean": 165.71,
    "success": 0.998,
    "settle_p95_s": 0.91,
    "rms_position_m": 0.00012,
    "failed": 6,
    "failures": [{"start": start} for start in (12, 40, 41, 90, 91, 700)],
    "baselines": {"lqr": {"return_mean": 120.6, "success": 0.923, "settle_p95_s": np.inf, "rms_position_m": np.nan}},
    "off_nominal": {"latency": {"success": 1.0}},
    "beside": {
        "ppo": {"env_steps": 99, "return_mean": 157.2, "success": 1.0, "settle_p95_s": 2.0, "rms_position_m": 0.02}
    },
}


class Stubs:
    """Runs and figures made up; `asked`: the commands that the gallery gave."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.asked = folder, list[list[str]]()
        monkeypatch.setattr(figures, "figures", self.figures)
        monkeypatch.setattr(figure_runs, "qrl", self.qrl)
        monkeypatch.setattr(gallery, "screenshot", lambda _, __, target: target.write_text("view"))

    def figures(self, names: list[str], out: Path, *_: Any, **__: Any) -> dict[str, Caption]:
        out.mkdir(parents=True, exist_ok=True)
        for name in names:
            for form in ("png", "md"):
                (out / f"{name}.{form}").write_text(f"{out.name} {name}")
        return CAPTIONS

    def qrl(self, words: list[str], *_: Any) -> None:
        self.asked.append(words)
        if words[0] == "train":
            one = RunSpec("", words[1], words[words.index("--preset") + 1] if "--preset" in words else words[1], {})
            folder = Path(words[words.index("--out") + 1])
            files.write_json(folder / "config.json", one.config().model_dump(mode="json"))
            files.write_json(folder / "summary.json", {})
        elif words[0] == "evaluate":
            files.write_json(Path(words[1]) / "evaluation.json", FOUND)
            for name in ("learning_curve", "flight", "evaluation", "settle"):
                (Path(words[1]) / f"{name}.png").write_text(f"{Path(words[1]).name} {name}")

    def bench(self) -> None:
        (self.folder / "runs" / "bench").mkdir(parents=True)
        (self.folder / "runs" / "bench" / "bench.md").write_text("# qrl beside other trainers and simulators\n\nfast\n")
        (self.folder / "runs" / "bench" / "bench.png").write_text("bench")

    def make(self, *words: str) -> Path:
        assert gallery.main(["--out", str(self.folder / "docs"), "--runs", str(self.folder / "runs"), *words]) == 0
        return self.folder / "docs" / "gallery.md"


@pytest.fixture
def stubs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Stubs:
    return Stubs(tmp_path, monkeypatch)


@pytest.fixture
def made(stubs: Stubs) -> Path:
    """The page of a gallery with all that there can be."""
    stubs.bench()
    return stubs.make()


def test_every_picture_is_there(made: Path) -> None:
    linked = re.findall(r"\]\((gallery/[^)]+)\)", made.read_text())
    assert len(linked) == len(set(linked))
    assert {(made.parent / link).name for link in linked} == {path.name for path in (made.parent / "gallery").iterdir()}
    assert (made.parent / "gallery" / "hover_settle.png").read_text() == "hover settle"


def test_each_claim_has_its_verdict(made: Path) -> None:
    for name, told in CAPTIONS.items():
        assert f"| [{told.title}](#{name}) | claims {name} | **{told.verdict}** |" in made.read_text()
        verdict = f"**{told.verdict.capitalize()}.** By a rule.\n([How it was made.](gallery/{name}.md))\n"
        assert f"- {name} is 3.\n\n{verdict}" in made.read_text()


def test_numbers_are_those_of_the_evaluation(made: Path) -> None:
    page = made.read_text()
    assert page.count("|  | policy | PPO | lqr |") == 3
    assert "| return | 165.7 | 157.2 | 120.6 |" in page
    assert "| success, % | 99.8 | 100.0 | 92.3 |" in page
    assert "| settle, p95, s | 0.91 | 2.00 | never |" in page
    assert "| steady state, mm | 0.1 | 20.0 | – |" in page
    assert "latency 100.0 %" in page
    assert (
        "`qrl train hover --seed 100 --seeds 1`, 1,234,000 steps;"
        " PPO: `qrl train hover --seed 100 --seeds 1 --preset hover_ppo`,\n99 s" in page
    )
    assert "6 starts fail: 12 40 41 90 91 …; `qrl view RUN --starts 12` replays one." in page


def test_what_other_commands_left_is_a_section(made: Path) -> None:
    assert "\n## qrl beside other trainers and simulators\n\nfast\n" in made.read_text()
    assert "objectives" not in made.read_text()


def test_runs_are_kept_unless_asked(stubs: Stubs) -> None:
    """Each is trained once, PPO's too, and flown beside it."""
    stubs.make()
    assert [words[0] for words in stubs.asked] == [*["train", "train", "evaluate"] * 3, "view"]
    evaluated = next(words for words in stubs.asked if words[0] == "evaluate" and words[1].endswith("/hover"))
    assert evaluated[2:] == ["--off-nominal", "--beside", f"{evaluated[1]}-ppo"]
    for flags, trained in (([], 0), (["--fresh"], 6)):
        stubs.asked.clear()
        stubs.make(*flags)
        assert sum(words[0] == "train" for words in stubs.asked) == trained


def test_fast_is_said(stubs: Stubs) -> None:
    page = stubs.make("--fast")
    assert "Made by `make gallery FAST=1`" in page.read_text()
    assert (page.parent / "gallery" / "circle.png").read_text() == "figures_fast circle"


def test_pictures_that_are_not_there_are_not_linked(stubs: Stubs, monkeypatch: pytest.MonkeyPatch) -> None:
    """No bench any more, and no Chromium."""
    stubs.bench()
    stubs.make()
    (stubs.folder / "runs" / "bench" / "bench.png").unlink()
    (stubs.folder / "docs" / "gallery" / "view.png").unlink()
    monkeypatch.setattr(gallery, "screenshot", lambda *_: None)
    page = stubs.make()
    assert not (page.parent / "gallery" / "bench.png").exists()
    assert "bench.png" not in page.read_text()
    assert "view.png" not in page.read_text()


def test_a_file_is_no_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "docs").write_text("")
    with pytest.raises(SystemExit) as end:
        gallery.main(["--out", str(tmp_path / "docs")])
    assert end.value.code == 2
    assert (
        capsys.readouterr().err == f"gallery: --out: {tmp_path}/docs is a file; expected a folder, or a name for a"
        " new one\n"
    )


def test_the_viewer_is_drawn_before_its_picture_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    driver = SimpleNamespace(get_screenshot_as_png=lambda: f"{len(asked)} calls".encode())
    monkeypatch.setattr(browser, "missing", list)
    monkeypatch.setattr(browser, "chromium", lambda _: nullcontext(driver))
    monkeypatch.setattr(browser, "drawn", lambda _, address: asked.append(address))
    monkeypatch.setattr(browser, "wait_for", lambda _, promise: asked.append(promise))
    gallery.screenshot(tmp_path / "view.html", "#start=1", tmp_path / "view.png")
    assert asked == [f"{(tmp_path / 'view.html').as_uri()}#start=1", browser.NEXT_FRAME]
    assert (tmp_path / "view.png").read_bytes() == b"2 calls"


@pytest.mark.parametrize("missing", [["chromium"], []])
def test_a_picture_that_cannot_be_taken_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], missing: list[str]
) -> None:
    """Without Chromium, or of a page that does not draw."""
    monkeypatch.setattr(browser, "missing", lambda: missing)
    monkeypatch.setattr(browser, "chromium", lambda _: nullcontext(SimpleNamespace(get_screenshot_as_png=bytes)))
    monkeypatch.setattr(browser, "drawn", lambda *_: "no scene")
    monkeypatch.setattr(browser, "wait_for", lambda *_: None)
    (tmp_path / "view.png").write_text("old")
    gallery.screenshot(tmp_path / "view.html", "", tmp_path / "view.png")
    assert (tmp_path / "view.png").read_text() == "old"
    assert ("missing here: chromium" if missing else "no scene") in capsys.readouterr().err
