"""What is installed, and from which pins."""

import ast
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT, GROUPS, SETUPTOOLS = (
    PYPROJECT["project"],
    PYPROJECT["dependency-groups"],
    PYPROJECT["tool"]["setuptools"],
)

# Standing apart at the top of the repository, installed below gridnav.
TOP_FOLDERS = ["envs", "agents", "assets"]

PIN = re.compile(
    r"(?P<name>[a-z0-9-]+)==(?P<version>[\w.+!]+)"
    r"( ; [\w\s.'<>=!()]+?)?"  # a marker, such as: sys_platform == 'win32'
    r"( --hash=sha256:[0-9a-f]{64})+"
)


def test_every_folder_with_modules_is_installed() -> None:
    found = set()
    for package, folder in SETUPTOOLS["package-dir"].items():
        for module in (ROOT / folder).rglob("*.py"):
            found.add(".".join([package, *module.parent.relative_to(ROOT / folder).parts]))

    assert found == set(SETUPTOOLS["packages"])


def test_every_installed_folder_is_a_package() -> None:
    for package in SETUPTOOLS["packages"]:
        folder = SETUPTOOLS["package-dir"].get(package, package.replace(".", "/"))
        assert (ROOT / folder / "__init__.py").exists(), folder


@pytest.mark.parametrize("folder", TOP_FOLDERS)
def test_no_folder_below_gridnav_hides_one_at_the_top(folder: str) -> None:
    assert not (ROOT / "gridnav" / folder).exists()


@pytest.mark.parametrize("folder", ["envs", "agents"])
def test_a_stub_leads_type_checkers_to_the_folder_at_the_top(folder: str) -> None:
    assert (ROOT / "gridnav" / f"{folder}.pyi").read_text() == f"from {folder} import *\n"


def test_nothing_imports_a_top_folder_by_its_bare_name() -> None:
    """`import envs` works in this repository alone, and makes a second copy of every class."""
    offenders = []
    for folder in ["gridnav", "scripts", "tests", *TOP_FOLDERS]:
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(), str(path))):
                names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
                if isinstance(node, ast.ImportFrom) and node.level == 0:
                    names = [str(node.module)]
                offenders += [f"{path}:{node.lineno}" for name in names if name.split(".")[0] in TOP_FOLDERS]

    assert offenders == []


@pytest.mark.parametrize("name", ["requirements.txt", "requirements-uv.txt"])
def test_pins_are_names_versions_markers_and_hashes_alone(name: str) -> None:
    """No address of an index: the pins must install from whichever one a machine uses."""
    assert "://" not in (ROOT / name).read_text()
    for line in requirement_lines(name):
        assert PIN.fullmatch(line), line


@pytest.mark.parametrize(
    ("name", "requirements"),
    [
        ("requirements.txt", PROJECT["dependencies"] + GROUPS["dev"]),
        ("requirements-uv.txt", GROUPS["setup"]),
    ],
)
def test_every_requirement_is_pinned_within_its_bounds(name: str, requirements: list[str]) -> None:
    pins: dict[str, list[str]] = {}
    for match in filter(None, map(PIN.fullmatch, requirement_lines(name))):
        pins.setdefault(match["name"], []).append(match["version"])

    for requirement in map(Requirement, requirements):
        versions = pins.get(canonicalize_name(requirement.name), [])
        assert versions, f"{requirement} has no pin: run `python3 start.py lock`"
        assert all(requirement.specifier.contains(version) for version in versions), (requirement, versions)


def test_a_wheel_holds_every_module_and_data_file_but_no_stub(tmp_path: Path) -> None:
    uv = Path(sysconfig.get_path("scripts")) / "uv"
    options = ["--quiet", "--no-build-isolation", "--python", sys.executable, "--out-dir", str(tmp_path)]
    subprocess.run([uv, "build", *options, str(ROOT)], check=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        held = {name for name in wheel.namelist() if ".dist-info/" not in name}

    expected = {"gridnav/py.typed"}
    for package, folder in SETUPTOOLS["package-dir"].items():
        for pattern in [
            "*.py",
            "mjcf/*.xml",
            "reality/*.seed",
            "templates/*.html",
            "templates/*.css",
            "templates/*.js",
        ]:
            files = (ROOT / folder).rglob(pattern)
            expected |= {f"{package.replace('.', '/')}/{file.relative_to(ROOT / folder).as_posix()}" for file in files}
    assert held == expected


def requirement_lines(name: str) -> list[str]:
    """The requirements of a file, one each, without comments and line breaks."""
    lines = (ROOT / name).read_text().splitlines()
    text = "\n".join(line for line in lines if not line.lstrip().startswith("#"))
    return [re.sub(r"\s+", " ", line).strip() for line in text.replace("\\\n", " ").splitlines()]
