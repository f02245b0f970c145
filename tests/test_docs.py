"""Pages and notebooks: links lead somewhere, nothing comes from the network, no key is missing, CI runs what runs."""

import ast
import importlib.util
import json
import re
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
import yaml

from depthreg.config import CONF_DIR

ROOT = Path(__file__).resolve().parents[1]
PAGES = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/*.md")])
NOTEBOOKS = sorted(ROOT.glob("notebooks/*.ipynb"))

pytestmark = pytest.mark.skipif(not NOTEBOOKS, reason="a source archive has neither docs/ nor notebooks/")


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    """What MkDocs runs while it builds."""
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs" / "hooks.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def leaves(node: Any, prefix: str = "") -> Iterator[str]:
    """Dotted keys of nested dictionaries; an empty one is a value."""
    for key, value in node.items():
        if isinstance(value, dict) and value:
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}"


def test_every_key_of_every_configuration_file_is_on_the_page(hooks: ModuleType) -> None:
    parts = [part.partition("\n") for part in re.split(r"^### ", hooks.keys_page(), flags=re.MULTILINE)]
    rows_of = {head.strip(): re.findall(r"^\| `([^`]+)` \|", text, re.MULTILINE) for head, _, text in parts}
    files = [path for path in CONF_DIR.rglob("*.yaml") if path.parent != CONF_DIR]
    assert len(files) > 70
    for path in files:
        name = path.relative_to(CONF_DIR).with_suffix("").as_posix()
        group = re.match(r"hydra/\w+|\w+", name)[0]
        keys = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
        keys.pop("defaults", None)
        assert rows_of[f"{group}={name.removeprefix(group + '/')}"] == list(leaves(keys)), path


def test_the_page_of_keys_has_their_comments_and_the_help_of_each_command(hooks: ModuleType) -> None:
    page = hooks.keys_page()
    assert "| `range_noise_m` | `0.02` | repeatability |" in page  # of conf/sensor/vlp16.yaml
    assert "| `focal_px` | `[600.0, 850.0]` | KITTI's 721 px, give or take |" in page
    for line in ("usage: depthreg train", "usage: depthreg render", "depthreg evaluate data=kitti data.root=kitti/"):
        assert line in page


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_relative_links_of_a_page_lead_to_files(path: Path) -> None:
    text = re.sub(r"```.*?```|`[^`\n]*`", "", path.read_text(encoding="utf-8"), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if not urlsplit(target).scheme and not target.startswith(("#", "keys.md")):  # keys.md is made by the build
            assert (path.parent / target.partition("#")[0]).exists(), target


class Links(HTMLParser):
    """What a page links to, what it loads, and which anchors it has."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links, self.loads, self.anchors = set[str](), set[str](), {""}
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.anchors |= {values.get("id") or "", values.get("name") or ""}
        target = values.get("href") or values.get("src")
        if target and not target.startswith(("data:", "mailto:")):
            loaded = tag != "a" and values.get("rel") not in ("canonical", "prev", "next")
            (self.loads if loaded else self.links).add(target)


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Links]:
    """The pages as `make docs` builds them, by their paths."""
    pytest.importorskip("material", reason="pip install 'depthreg[docs]'")
    from mkdocs.commands.build import build
    from mkdocs.config import load_config

    folder = tmp_path_factory.mktemp("site")
    config = load_config(str(ROOT / "mkdocs.yml"), site_dir=str(folder), strict=True)
    config.plugins.on_startup(command="build", dirty=False)
    build(config)
    return {path: Links(path.read_text(encoding="utf-8")) for path in sorted(folder.rglob("*.html"))}


def test_every_link_within_the_site_leads_to_a_page_and_a_heading(site: dict[Path, Links]) -> None:
    assert {"index.html", "tour.html", "keys.html", "faq.html", "api.html"} <= {path.name for path in site}
    for path, page in site.items():
        for target in page.links | page.loads:
            parts = urlsplit(target)
            if (
                path.name == "404.html" or parts.scheme or parts.netloc
            ):  # the error page doesn't know where it will stand
                continue
            there = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            assert there.exists(), f"{path.name}: {target}"
            if parts.fragment and there in site:
                assert unquote(parts.fragment) in site[there].anchors, f"{path.name}: {target}"


def test_no_page_loads_anything_from_the_network(site: dict[Path, Links]) -> None:
    assert not {target for page in site.values() for target in page.loads if urlsplit(target).netloc}
    for sheet in next(iter(site)).parent.rglob("*.css"):
        assert not re.search(r"(url\(|@import)\s*['\"]?(https?:)?//", sheet.read_text(encoding="utf-8")), sheet


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_holds_sound_python_and_no_output(path: Path) -> None:
    notebook = json.loads(path.read_text(encoding="utf-8"))
    assert notebook["nbformat"] == 4 and notebook["cells"][0]["cell_type"] == "markdown"
    for cell in notebook["cells"]:
        if cell["cell_type"] == "code":
            ast.parse("".join(cell["source"]))
            assert not cell["outputs"] and cell["execution_count"] is None


def test_ci_runs_the_notebooks_and_builds_the_pages() -> None:
    jobs = yaml.safe_load((ROOT / ".github/workflows/docs.yaml").read_text(encoding="utf-8"))["jobs"].values()
    commands = [step.get("run", "") for job in jobs for step in job["steps"]]
    assert {"make docs", "make notebooks"} <= set(commands)
    recipes = dict(
        re.findall(r"^(\w+):.*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    )
    assert "pytest --nbmake" in recipes["notebooks"] and " notebooks" in recipes["notebooks"]
    assert "mkdocs build --strict" in recipes["docs"]
