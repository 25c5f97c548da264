"""The speed benchmark: a short run holds every row, and its ratios follow from its rows."""

import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "benchmark.py"
WORLDS = ("GridWorld", "Unicycle", "DiffDrive")


def run(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, str(SCRIPT), *words], capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path, str]:
    """One short run: what it wrote, the picture, what it printed. Its peers' interpreter lacks the peers."""
    folder = tmp_path_factory.mktemp("benchmark")
    result = run(
        "--quick", "--peers", sys.executable, "--json", str(folder / "x.json"), "--figure", str(folder / "x.png")
    )
    assert result.returncode == 0, result.stderr
    return json.loads((folder / "x.json").read_text()), folder / "x.png", result.stdout


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    spec = importlib.util.spec_from_file_location("benchmark", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["benchmark"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_a_quick_run_times_every_row(quick: tuple[dict[str, Any], Path, str]) -> None:
    report, _, printed = quick
    rows = {row["name"]: row for row in report["rows"]}

    expected = {
        f"{world} N={n}" for world in (*WORLDS, "bare physics", "GridWorld's arrays alone") for n in (1, 16, 64)
    }
    expected |= {f"{world} single" for world in WORLDS} | {"DiffDrive single, unwrapped", "mj_step", "lidar scan N=64"}
    expected |= {"SyncVectorEnv x8", "FrozenLake-v1"}
    assert set(rows) == expected
    for name, row in rows.items():
        assert len(row["samples"]) == report["rounds"] == 2, name
        assert 0.0 < row["min"] <= row["median"] <= row["max"] < math.inf, name
        assert name in printed


def test_a_ratio_is_taken_within_each_round_and_names_its_target(quick: tuple[dict[str, Any], Path, str]) -> None:
    report, _, _ = quick
    samples = {row["name"]: row["samples"] for row in report["rows"]}
    ratios = {ratio["name"]: ratio for ratio in report["ratios"]}

    ratio = ratios["DiffDrive of bare physics, N=16"]
    assert (ratio["target"], ratio["at_least"]) == (0.8, True)
    own, bare = samples["DiffDrive N=16"], samples["bare physics N=16"]
    first, second = own[0] / bare[0], own[1] / bare[1]
    assert ratio["samples"] == pytest.approx([first, second])
    assert ratio["median"] == pytest.approx((first + second) / 2)
    assert ratio["is_met"] == ((first + second) / 2 >= 0.8)
    # The lidar's share is one of time, so the bare physics' rate stands above the line.
    share = ratios["lidar scan, share of bare physics, N=64"]
    assert (share["target"], share["at_least"]) == (0.1, False)
    assert share["rows"] == ["bare physics N=64", "lidar scan N=64"]


def test_peers_that_are_not_installed_are_named_and_left_out(quick: tuple[dict[str, Any], Path, str]) -> None:
    report, _, printed = quick

    for name, module in (("MiniGrid-FourRooms-v0", "minigrid"), ("PointMaze_UMaze-v3", "gymnasium_robotics")):
        assert module in report["left_out"][name]
        assert f"left out: {name}" in printed
    assert "gymnasium" in report["peer_versions"]


def test_the_report_says_where_it_was_made_but_holds_no_path(quick: tuple[dict[str, Any], Path, str]) -> None:
    report, picture, _ = quick

    assert {"python", "mujoco", "numpy", "gymnasium", "numba"} <= set(report["versions"])
    assert report["machine"]["cores"] >= 1
    assert 0.0 < report["model"]["timestep_s"] < report["model"]["control_period_s"]
    assert str(SCRIPT.parents[1]) not in json.dumps(report)
    assert str(picture.parent) not in json.dumps(report)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_rate_counts_environment_steps_and_not_calls(benchmark: ModuleType) -> None:
    row = benchmark.Row("by hand", "DiffDrive", 4, lambda calls: 0.5 * calls)

    # By hand: two calls of 4 steps take 1 s. A slot of 3 s holds three such runs: 24 steps in 3 s.
    assert benchmark.rate(row, 2, 3.0) == pytest.approx(8.0)


def test_a_peer_that_fails_is_left_out_and_a_world_of_ours_is_not(benchmark: ModuleType) -> None:
    def broken(calls: int) -> float:
        raise RuntimeError("no more")

    left_out: dict[str, str] = {}
    works = benchmark.Row("works", "DiffDrive", 1, lambda calls: 1.0)
    rates = benchmark.measure([works, benchmark.Row("fails", benchmark.PEER, 1, broken)], 2, 0.1, left_out)

    assert set(rates) == {"works"}
    assert left_out == {"fails": "RuntimeError: no more"}
    with pytest.raises(RuntimeError, match="no more"):
        benchmark.measure([benchmark.Row("fails", "DiffDrive", 1, broken)], 2, 0.1, {})


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--fast"], "--fast"),
        (["--rounds", "0"], "--rounds"),
        (["--slot", "nan"], "--slot"),
        (["--workers", "9"], "--workers"),
        (["--peers", "no-such-python"], "no-such-python"),
        (["--json", "no-such-folder/x.json"], "no-such-folder"),
        (["--figure", "x.docx"], "x.docx"),
    ],
)
def test_wrong_arguments_end_with_2_before_anything_is_measured(words: list[str], named: str) -> None:
    result = run("--quick", *words)

    assert result.returncode == 2
    assert named in result.stderr
    assert "warming up" not in result.stderr
