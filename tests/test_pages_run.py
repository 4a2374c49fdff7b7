"""Every command and scenario of the feature pages runs as it is printed, in a folder of its own."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = ["cuts", "resections", "contact", "tissues-and-loads", "steps", "companions", "finite-strain-model"]
PROGRAMS = {"python": [sys.executable], "xfemnav": [sys.executable, "-c", "from xfemnav_cli.main import main; main()"]}
FIRST = "python -m data_synthetic.surgery out/surgery"


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """One cache for all pages: their slice is the same."""
    return tmp_path_factory.mktemp("cache")


@pytest.mark.parametrize("page", PAGES)
def test_a_page_writes_its_scenario_where_its_command_reads_it(page):
    text = (ROOT / f"docs/{page}.md").read_text()
    saved = re.findall(r"[Ss]ave as `(out/surgery/[\w-]+\.toml)`", text)
    read = set(re.findall(r"^ {4}xfemnav run --scenario (\S+)", text, re.MULTILINE))
    assert FIRST in text
    assert read == set(saved or ["out/surgery/surgery.toml"])


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_a_page_runs_as_it_is_written(page, cache, tmp_path):
    text = (ROOT / f"docs/{page}.md").read_text()
    environment = os.environ | {"PYTHONPATH": str(ROOT), "XFEMNAV_CACHE": str(cache)}

    def call(line: str) -> int:
        name, *words = shlex.split(line)
        return subprocess.run([*PROGRAMS[name], *words], cwd=tmp_path, env=environment, check=False).returncode

    assert call(FIRST) == 0
    scenarios = re.findall(r"^```toml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    files = re.findall(r"[Ss]ave as `(out/surgery/[\w-]+\.toml)`", text)
    for name, scenario in zip(files, scenarios):
        (tmp_path / name).write_text(scenario)
    lines = re.findall(r"^ {4}(xfemnav run .*)$", text, re.MULTILINE)
    for number, scenario in enumerate(scenarios[1:]):
        (tmp_path / f"out/surgery/more-{number}.toml").write_text(scenario)
        lines.append(f"xfemnav run --scenario out/surgery/more-{number}.toml -o out/more-{number}")
    for line in lines:
        # Of all runs only that of free lips is there to show what is not to be trusted.
        assert call(line) == (3 if "--lips free" in line else 0), line
        record = json.loads((tmp_path / line.split("-o ")[1] / "run.json").read_text())
        assert {item["code"] for item in record["warnings"]} <= {"W403", "W404"}, line
