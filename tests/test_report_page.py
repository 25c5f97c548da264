"""The report in a real browser: on a phone and a desk, in light and dark, drawn whole, sorted by a click."""

from __future__ import annotations

import functools
import http.server
import json
import re
import shutil
import subprocess
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from gridnav import Layout, Reward, Task
from gridnav.agents import Planner
from gridnav.display.figures import episode_strip, trajectories
from gridnav.display.report import Picture, Report, Rung, write_report
from gridnav.experiment.evaluation import evaluate_in
from gridnav.experiment.worlds import Problem
from gridnav.problem.metrics import summarise

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here (Debian package chromium)")

# Loads the report in a frame, looks at it from outside, and leaves what it saw in its own body.
LOOK = """<!DOCTYPE html><meta charset="utf-8"><body style="margin:0">
<iframe src="report.html" style="width:WIDTHpx;height:800px;border:0"></iframe>
<script>
const errors = [];
document.querySelector("iframe").addEventListener("load", event => {
  const view = event.target.contentWindow, page = view.document;
  view.addEventListener("error", problem => errors.push(problem.message));
  const column = () => [...page.querySelectorAll("tbody tr")].map(row => row.children[2].dataset.value);
  const before = column();
  page.querySelectorAll("thead button")[2].click();
  const down = column();
  page.querySelectorAll("thead button")[2].click();
  const seen = {
    overflow: page.documentElement.scrollWidth - page.documentElement.clientWidth,
    drawings: [...page.querySelectorAll("figure svg")].map(svg => {
      const box = svg.getBoundingClientRect();
      return [box.width, box.height, svg.querySelectorAll("path").length];
    }),
    background: view.getComputedStyle(page.body).backgroundColor,
    before, down, up: column(), errors,
  };
  document.body.innerHTML = "<pre>" + JSON.stringify(seen) + "</pre>";
});
</script>"""


LAYOUT = Layout.from_text("S...\n.##.\n...G")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """A folder with the report of a plan that drives in three worlds, served to this machine."""
    run = tmp_path_factory.mktemp("report")
    problem = Problem(LAYOUT, Task(), Reward())
    plan = Planner.solve(problem.layout, problem.task, problem.reward)
    driven = {world: evaluate_in(problem, plan, world, 6) for world in ("GridWorld", "Unicycle", "DiffDrive")}
    lost = [replace(one, is_success=False) for one in driven["Unicycle"][:3]]
    driven["Unicycle"][:3] = lost
    rows = [Rung(world, world, "plan", "", summarise(one), 0, 0.0) for world, one in driven.items()]
    shown = [
        Picture(trajectories(LAYOUT, driven), "Where they drove."),
        Picture(episode_strip(LAYOUT, driven["DiffDrive"][0]), "Step by step."),
    ]
    page = Report("Three worlds", "Does it fit?", "It does.", rows, shown, {"seed": 0}, "gridnav ladder")
    write_report(run / "report.html", page)
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(run))
    handler.log_message = lambda *_: None  # type: ignore[attr-defined]
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield run, f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def look(site: tuple[Path, str], tmp_path: Path, width: int, *flags: str) -> tuple[dict[str, Any], str]:
    """What the page looks like from a frame of that width, and what the browser complained about."""
    run, address = site
    (run / "look.html").write_text(LOOK.replace("WIDTH", str(width)), encoding="utf-8")
    done = subprocess.run(
        [
            str(CHROMIUM), "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom",
            f"--window-size={max(width, 500)},800", "--virtual-time-budget=10000", *flags,
            f"--user-data-dir={tmp_path / 'profile'}", f"{address}/look.html",
        ],
        capture_output=True, timeout=120, check=True, text=True,
    )  # fmt: skip
    found = re.search(r"<pre>(.*)</pre>", done.stdout, re.DOTALL)
    assert found, done.stderr[-2000:]
    return json.loads(found.group(1)), "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_fits_draws_everything_and_says_no_error(
    width: int, scheme: str, site: tuple[Path, str], tmp_path: Path
) -> None:
    seen, complaints = look(site, tmp_path, width, f"--blink-settings=preferredColorScheme={int(scheme == 'light')}")

    assert seen["overflow"] <= 0, "the page scrolls sideways"
    assert seen["drawings"], "there are no figures"
    for drawn_width, drawn_height, paths in seen["drawings"]:
        assert drawn_width > 200
        assert drawn_height > 50
        assert paths > 5
        assert drawn_width <= width
    brightness = sum(int(number) for number in re.findall(r"\d+", seen["background"])[:3])
    assert (brightness > 600) == (scheme == "light"), seen["background"]
    assert seen["errors"] == []
    assert complaints == ""


def test_a_click_sorts_the_table_and_another_turns_it_round(site: tuple[Path, str], tmp_path: Path) -> None:
    seen, _ = look(site, tmp_path, 1280)
    numbers = [float(value) for value in seen["before"]]
    assert [float(value) for value in seen["down"]] == sorted(numbers, reverse=True)
    assert [float(value) for value in seen["up"]] == sorted(numbers)
