"""``gridnav view``: which episode is shown, where, and what is said where it cannot be."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import run_cli
from PIL import Image
from rerun.chunk import RrdReader

from gridnav.display.viewer import ViewerError, is_open, wait_until, web_viewer
from gridnav.experiment.rollouts import load_rollouts
from gridnav.experiment.viewing import Pick
from gridnav.problem.types import InputError

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Q-learning that learnt too little: some of its episodes fail."""
    run = tmp_path_factory.mktemp("runs") / "q"
    words = ["train", "--layout", "S...\n.##.\n...G", "--task", "any", "--seed", "1", "--budget", "quick"]
    with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
        assert run_cli(*words, "--set", "visits=1", "num_envs=4", "--run-dir", str(run)) == 0
    rollouts = load_rollouts(run / "rollouts", "q-learning")
    assert 0 < sum(one.is_success for one in rollouts.episodes) < len(rollouts.episodes), "the tests below need both"
    return run


def entities(path: Path) -> set[str]:
    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def card(path: Path) -> str:
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/run_card" and "TextDocument:text" in batch.schema.names:
            return str(batch.column("TextDocument:text").to_pylist()[0][0])
    raise AssertionError("no run card")


def refused(capsys: pytest.CaptureFixture[str], code: int, *arguments: str) -> str:
    capsys.readouterr()
    assert run_cli("view", *arguments) == code
    (line,) = capsys.readouterr().err.splitlines()
    return line


# ---- Picking -----------------------------------------------------------------------------------


def test_episodes_are_picked_by_number_and_by_outcome(run: Path) -> None:
    rollouts = load_rollouts(run / "rollouts", "q-learning")
    returns = [one.episode_return for one in rollouts.episodes]

    assert Pick().number(rollouts) == 0
    assert Pick(episode=3).number(rollouts) == 3
    assert returns[Pick(worst=True).number(rollouts)] == min(returns)
    first = Pick(failed=True).number(rollouts)
    assert [one.is_success for one in rollouts.episodes[: first + 1]] == [True] * first + [False]
    with pytest.raises(InputError, match=f"episodes 0 to {len(returns) - 1}"):
        Pick(episode=len(returns)).number(rollouts)
    with pytest.raises(InputError, match="exclude each other"):
        Pick(worst=True, failed=True)


def test_the_worst_episode_becomes_a_recording(run: Path, tmp_path: Path) -> None:
    assert run_cli("view", str(run), "--failed", "--save", str(tmp_path / "f.rrd")) == 0
    assert "**missed**" in card(tmp_path / "f.rrd")
    assert r"/rollouts/q-learning\ on\ GridWorld/policy/values" in entities(tmp_path / "f.rrd")


def test_runs_stand_side_by_side(run: Path, tmp_path: Path) -> None:
    again, saved = shutil.copytree(run, tmp_path / "again"), tmp_path / "two.rrd"
    assert run_cli("view", str(run), "--compare", str(again), "--episode", "2", "--save", str(saved)) == 0
    assert len([path for path in entities(saved) if path.startswith("/return/")]) == 2


def test_all_episodes_lie_one_above_the_other(run: Path, tmp_path: Path) -> None:
    assert run_cli("view", str(run), "--overlay", "--save", str(tmp_path / "all.rrd")) == 0
    assert {"/maze/walls", "/trails/arrived", "/trails/missed", "/robots", "/arrived"} <= entities(tmp_path / "all.rrd")


def test_the_same_episode_gives_an_equal_recording(run: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        assert run_cli("view", str(run), "--worst", "--save", str(tmp_path / f"{name}.rrd")) == 0
    rerun = Path(sys.executable).with_name("rerun")
    files = [str(tmp_path / "a.rrd"), str(tmp_path / "b.rrd")]
    done = subprocess.run([str(rerun), "rrd", "compare", "--unordered", *files], capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()


# ---- What cannot be shown ----------------------------------------------------------------------


def test_what_cannot_be_shown_is_said_in_one_line(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    out = str(tmp_path / "out.rrd")
    assert "episodes 0 to" in refused(capsys, 2, str(run), "--episode", "9999", "--save", out)
    assert "there are q-learning" in refused(capsys, 2, str(run), "--rollouts", "ppo", "--save", out)
    assert "exclude each other" in refused(capsys, 2, str(run), "--web", "--save", out)
    assert "must end with .rrd" in refused(capsys, 2, str(run), "--save", str(tmp_path / "out.txt"))
    assert "there is no folder" in refused(capsys, 2, str(run), "--save", str(tmp_path / "none" / "out.rrd"))
    assert "leave" in refused(capsys, 2, str(run), "--overlay", "--worst", "--save", out)
    assert "not a run directory" in refused(capsys, 2, str(tmp_path))
    if sys.platform == "linux":
        assert "no display" in refused(capsys, 3, str(run))
    assert not Path(out).exists()


def test_a_recording_that_is_cut_off_or_none_is_refused(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = Path(shutil.copytree(run, tmp_path / "broken"))
    whole = (run / "rollout.rrd").read_bytes()
    for content in (whole[: len(whole) // 2], b"no recording", b""):
        (broken / "rollout.rrd").write_bytes(content)
        assert "is no whole recording" in refused(capsys, 2, str(broken), "--save", str(tmp_path / "out.rrd"))
    (broken / "rollout.rrd").unlink()
    assert "has not finished" in refused(capsys, 2, str(broken))
    shutil.rmtree(broken / "rollouts")
    assert "no rollouts" in refused(capsys, 2, str(broken), "--worst")


def test_a_port_that_is_taken_is_named(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = str(taken.getsockname()[1])
        assert f"port {port} is in use" in refused(capsys, 3, str(run), "--web", "--port", port)


# ---- In a browser ------------------------------------------------------------------------------


def sockets_of_viewers() -> set[tuple[str, int]]:
    """Address and port, as the kernel writes the first, of every TCP socket on which a `rerun` process listens."""
    inodes = set()
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if b"rerun" in (process / "cmdline").read_bytes():
                inodes |= {os.readlink(fd) for fd in (process / "fd").iterdir()}
    found = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            local, state, inode = (line.split()[column] for column in (1, 3, 9))
            if state == "0A" and f"socket:[{inode}]" in inodes:
                address, port = local.split(":")
                found.add((address, int(port, 16)))
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
def test_the_browser_s_page_is_served_to_this_machine_alone_and_ends_with_the_block(run: Path) -> None:
    with web_viewer(run / "rollout.rrd") as (address, is_running):
        assert is_running()
        page = int(address.split(":")[2].split("/")[0])
        sockets = sockets_of_viewers()
        assert page in {port for _, port in sockets}
        # 127.0.0.1 and ::1 on a little-endian machine.
        assert {host for host, _ in sockets} <= {"0100007F", "00000000000000000000000001000000"}
    wait_until(lambda: not is_open(page), "end with the block")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here (Debian package chromium)")
def test_a_browser_draws_the_scene(run: Path, tmp_path: Path) -> None:
    def n_colours(address: str) -> int:
        picture = tmp_path / "page.png"
        subprocess.run(
            [
                str(CHROMIUM), "--headless=new", "--no-sandbox", "--use-angle=swiftshader",
                "--enable-unsafe-swiftshader",
                "--window-size=1280,800", "--virtual-time-budget=30000", "--timeout=40000",
                f"--user-data-dir={tmp_path / 'profile'}", f"--screenshot={picture}", address,
            ],
            capture_output=True, timeout=120, check=True,
        )  # fmt: skip
        return len(np.unique(np.asarray(Image.open(picture).convert("RGB")).reshape(-1, 3), axis=0))

    with web_viewer(run / "rollout.rrd") as (address, _):
        # A picture is taken after a while: on a busy machine that may be too early.
        assert any(n_colours(address) > 200 for _ in range(4)), "the page is blank"


def test_a_missing_recording_is_no_page() -> None:
    with pytest.raises(ViewerError, match="there is no recording"), web_viewer("none.rrd"):
        pass
