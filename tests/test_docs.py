"""The documentation works as printed: the afternoon's commands, all links, all figures."""

import configparser
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
PROJECT = ("algos", "constraints", "core", "envs", "plots", "store", "sweep", "run.py", "plot.py", "tables.py")
# Settings of a training and the values that the test uses instead.
SHORTER = {"steps": 300, "learning_starts": 100, "eval_every": 150, "hidden": "16,16"}
FEW_EPISODES = " eval_episodes=1 final_episodes=1"


def shorten(command):
    """The command with fewer steps and episodes and smaller networks; unchanged if it does not set `steps`."""
    if " steps=" not in command:
        return command
    for key, value in SHORTER.items():
        command = re.sub(rf" {key}=\S+", f" {key}={value}", command)
    return re.sub(r" (eval_episodes|final_episodes)=\S+", "", command) + FEW_EPISODES


def test_the_afternoon_happens_as_printed(tmp_path):
    page = (DOCS / "afternoon.md").read_text()
    for name in PROJECT:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, tmp_path)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(tmp_path)}
    blocks = re.findall(r"^```(\w+)([^\n]*)\n(.*?)^```", page, re.DOTALL | re.MULTILINE)
    assert {language for language, _, _ in blocks} == {"python", "bash"}
    for language, title, text in blocks:
        if language == "python":
            (tmp_path / re.fullmatch(r' title="(\w+\.py)"', title)[1]).write_text(text)
            continue
        for command in map(shorten, text.splitlines()):
            command = re.sub(r"^python ", f"{shlex.quote(sys.executable)} ", command)
            done = subprocess.run(command, shell=True, cwd=tmp_path, env=environment, capture_output=True, text=True)
            assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"

    results = [json.loads(path.read_text()) for path in (tmp_path / "results").glob("*/*/*/result.json")]
    assert len(results) == 27  # four algorithms and two tasks, one algorithm with a second setting; three seeds
    assert all(result["steps"] == 300 and result["largest_violation"] <= 1e-6 for result in results)
    for pattern in re.findall(r"^\| (`(?:tables|figures)/[^|]*) \|", page, re.MULTILINE):
        for name in re.findall(r"`((?:tables|figures)/[^`,.]+)", pattern):
            assert list((tmp_path / "results").glob(f"{name}*")), name
    for table in ("rewards", "tasks", "hyperparameters"):
        latex = (tmp_path / "results" / "tables" / f"{table}.tex").read_text()
        assert ("R+P" if table == "tasks" else "DNear") in latex


def anchors(page):
    """The anchors of a page's headings, as GitHub and the site make them."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_somewhere_in_the_repository(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if target.startswith("https://"):
            continue
        name, _, anchor = target.partition("#")
        linked = page.parent / name if name else page
        assert linked.is_file(), target
        assert not anchor or anchor in anchors(linked), target


def test_every_page_and_every_picture_is_reachable():
    text = "".join(page.read_text() for page in PAGES) + (ROOT / "mkdocs.yml").read_text()
    for path in [*DOCS.rglob("*.md"), *DOCS.glob("*.png")]:
        assert path.relative_to(DOCS).as_posix() in text, path


def test_every_module_that_the_docs_run_is_there():
    for page in PAGES:
        for module in re.findall(r"python (?:-m )?((?:bench|plots)[/.]\w+)", page.read_text()):
            assert (ROOT / (module.replace(".", "/").removesuffix("/py") + ".py")).is_file(), module


def test_the_citation_file_cites_the_paper_and_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    settings = configparser.ConfigParser()
    settings.read(ROOT / "setup.cfg")
    assert citation["version"] == settings["metadata"]["version"]
    doi = citation["preferred-citation"]["doi"]
    assert f"https://doi.org/{doi}" in (ROOT / "README.md").read_text()


def test_no_page_loads_anything_from_elsewhere():
    settings = (ROOT / "mkdocs.yml").read_text()
    assert "font: false" in settings and "http" not in settings
    assert "http" not in (DOCS / "style.css").read_text()
