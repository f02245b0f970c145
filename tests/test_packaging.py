"""A wheel, an editable install and a plain checkout, each used from another folder."""

import os
import re
import shlex
import subprocess
import sys
import tomllib
import zipfile
from email import message_from_string
from email.message import Message
from importlib.metadata import distribution
from pathlib import Path

import pytest
import yaml
from hydra.types import RunMode
from omegaconf import OmegaConf

import depthreg
from depthreg.config import compose_config, open_hydra
from depthreg.sweeps import expand_globs, samples_of

ROOT = Path(__file__).resolve().parents[1]
WAYS = ["wheel", "editable install", "checkout"]


def run(*command: str | Path, cwd: Path, pythonpath: Path | None = None) -> str:
    """Standard output of a command; `pythonpath` goes before what is installed, `cwd` is never searched."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"} | {"PYTHONSAFEPATH": "1"}
    if pythonpath:
        environment["PYTHONPATH"] = str(pythonpath)
    return subprocess.run(command, cwd=cwd, env=environment, check=True, stdout=subprocess.PIPE, text=True).stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from the checkout without a network."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, cwd=ROOT)
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def unpacked(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that pip installed the wheel into."""
    folder = tmp_path_factory.mktemp("site")
    options = ("--quiet", "--no-deps", "--no-index", "--no-compile", "--target", folder)
    run(sys.executable, "-m", "pip", "install", *options, wheel, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> Message:
    """The wheel's METADATA."""
    with zipfile.ZipFile(wheel) as archive:
        name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return message_from_string(archive.read(name).decode())


@pytest.mark.parametrize("way", WAYS)
def test_the_command_finds_its_configuration_from_any_folder(way: str, unpacked: Path, tmp_path: Path) -> None:
    pythonpath = {"wheel": unpacked, "editable install": None, "checkout": ROOT}[way]
    printed = run(sys.executable, "-m", "depthreg", "train", "--cfg", "all", cwd=tmp_path, pythonpath=pythonpath)
    config = yaml.safe_load(printed)
    places = {source["provider"]: source["path"] for source in config["hydra"]["runtime"]["config_sources"]}
    assert Path(places["main"]) == (unpacked / "depthreg" / "conf" if way == "wheel" else ROOT / "conf")
    assert config["curriculum"] == ["joint", "completion", "full"]  # the paper's curriculum, in its order
    assert not list(tmp_path.iterdir())


def test_the_wheel_holds_every_configuration_file_the_comparisons_page_and_its_types_but_no_tests(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    expected = {f"depthreg/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "conf").rglob("*.yaml")}
    assert {name for name in names if name.endswith(".yaml")} == expected
    page = {f"depthreg/comparison/page.{suffix}" for suffix in ("html", "css", "js")}
    assert {"depthreg/py.typed", "hydra_plugins/depthreg_optuna.py", *page} <= names
    assert {name.split("/")[0] for name in names} == {
        "depthreg",
        "hydra_plugins",  # a namespace that Hydra's plugins share: no file of ours makes a package of it
        f"depthreg-{depthreg.__version__}.dist-info",
    }
    assert "hydra_plugins/__init__.py" not in names


@pytest.mark.parametrize("way", ["wheel", "editable install"])
def test_the_console_script_says_the_version(way: str, unpacked: Path, tmp_path: Path) -> None:
    folder, pythonpath = (unpacked / "bin", unpacked) if way == "wheel" else (Path(sys.executable).parent, None)
    script = next(folder.glob("depthreg*"))  # depthreg.exe on Windows
    assert run(script, "--version", cwd=tmp_path, pythonpath=pythonpath) == f"depthreg {depthreg.__version__}\n"


def test_the_metadata_names_the_pythons_and_the_version(metadata: Message) -> None:
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["Version"] == distribution("depthreg").version == depthreg.__version__
    assert metadata["License-Expression"] == "Apache-2.0"


def test_every_requirement_is_pinned_at_its_floor_or_above(metadata: Message) -> None:
    packaging = pytest.importorskip("packaging.requirements")
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = dict(line.lower().replace("_", "-").split("==") for line in lines if line and not line.startswith("#"))
    for text in metadata.get_all("Requires-Dist", []):
        requirement = packaging.Requirement(text)
        if requirement.name != "depthreg":
            assert requirement.specifier.contains(pins[requirement.name.lower().replace("_", "-")], prereleases=True), (
                text
            )


def test_constraints_name_versions_only() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert all(re.fullmatch(r"#.*|[\w.-]+==[\w.]+", line) for line in lines)
    assert not re.search(r"nvidia|cuda|triton|\+cpu", "\n".join(line for line in lines if line[:1] != "#"))


def test_the_citation_is_of_this_version() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert citation["version"] == depthreg.__version__
    assert citation["license"] == project["license"]
    assert [reference["doi"] for reference in citation["references"]] == ["10.3390/s25113328"]  # the paper's


def test_every_command_of_the_readme_and_the_documentation_composes() -> None:
    text = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "README.md", *ROOT.glob("docs/*.md")))
    commands = set(re.findall(r"^ {4}depthreg (train|evaluate|render|gallery)\b *(.*?)(?: *#.*)?$", text, re.MULTILINE))
    assert {name for name, _ in commands} == {"train", "evaluate", "render", "gallery"}
    for name, overrides in commands:
        words = [
            word for word in shlex.split(overrides.partition(" --")[0]) if word != "-m" and not word.startswith("hydra")
        ]
        with open_hydra(name) as hydra:
            mode = RunMode.MULTIRUN if "-m" in overrides.split() else RunMode.RUN
            settings = OmegaConf.create({"mode": mode, "sweeper": {}})
            samples = samples_of(hydra, expand_globs(hydra, words), settings)
        for sample in samples:
            compose_config(name, sample)  # raises for unknown keys
