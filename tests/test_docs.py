"""What README.md and the pages in docs/ show and link is there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page: Path) -> None:
    """To files beside the page, and to its own headings and anchors."""
    text = page.read_text(encoding="utf-8")
    headings = {
        re.sub(r"[^\w -]", "", line).strip().lower().replace(" ", "-") for line in re.findall(r"^#+ (.+)", text, re.M)
    }
    anchors = headings | set(re.findall(r'<a id="([^"]+)">', text))
    links = [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if "://" not in link]
    assert links or page.name != "README.md"
    for link in links:
        file, _, anchor = link.partition("#")
        assert not file or (page.parent / file).exists(), link
        assert file or anchor in anchors, link


@pytest.mark.parametrize("folder", ["docs", "docs/gallery"])
def test_no_picture_is_left_over(folder: str) -> None:
    """Each picture in docs/ is shown by some page."""
    shown = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
    for picture in (ROOT / folder).glob("*.png"):
        assert f"{picture.parent.name}/{picture.name})" in shown, picture
