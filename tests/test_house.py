"""What the house promises: README's commands, the layers, the links of the pages, the licences."""

import re
import subprocess
import sys
import tomllib
from importlib import import_module
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from relight.cli import _COMMANDS

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PAGES = sorted(
    page
    for page in ROOT.rglob("*.md")
    if not any(part.startswith(".") or part == "demo" for part in page.relative_to(ROOT).parts)
)


def make_targets():
    """Target to its recipe lines."""
    targets, recipe = {}, []
    for line in (ROOT / "Makefile").read_text().splitlines():
        if match := re.match(r"^([a-z-]+):", line):
            recipe = targets.setdefault(match[1], [])
        elif line.startswith("\t"):
            recipe.append(line.strip())
    return targets


def test_the_make_commands_of_the_readme_exist():
    asked = set(re.findall(r"\bmake ([a-z-]+)", (ROOT / "README.md").read_text()))
    assert {"demo", "test"} <= asked
    assert asked <= set(make_targets())


def test_the_pip_commands_of_the_readme_are_those_of_make():
    readme = (ROOT / "README.md").read_text()
    makefile = (ROOT / "Makefile").read_text().replace("$(BIN)", ".venv/bin").replace("$(VENV)", ".venv")
    makefile = makefile.replace("$(PYTHON)", "python3.11").replace(" --quiet", "")
    spelled = re.findall(r"^    ((?:python3\.11|\.venv/bin/\w+) .*?)(?:\s+#.*)?$", readme, re.MULTILINE)
    assert len(spelled) >= 4
    for command in spelled[:4]:
        assert command in makefile, command


def test_ci_runs_the_readmes_test_command_last():
    lines = (ROOT / ".ci/run").read_text().split()
    assert (ROOT / ".ci/run").stat().st_mode & 0o111
    assert lines[-1] == "test"
    assert "pipefail" in lines


def test_every_command_is_in_the_readme_and_can_be_imported():
    readme = (ROOT / "README.md").read_text()
    for name, (module, summary) in _COMMANDS.items():
        assert f"`relight {name}" in readme, name
        assert summary
        for needed in ("add_arguments", "run", "EXAMPLE"):
            assert hasattr(import_module(module), needed), f"{module}.{needed}"


def test_the_entry_points_lead_to_functions():
    for target in PROJECT["scripts"].values():
        module, _, function = target.partition(":")
        assert callable(getattr(import_module(module), function))


def test_nothing_points_back():
    script = Path(sys.executable).parent / "lint-imports"
    result = subprocess.run([script, "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_of_a_page_lead_somewhere(page):
    text = page.read_text()
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        if "://" not in target:
            assert (page.parent / target).exists(), target


def test_the_licence_is_the_whole_apache_licence():
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License" in text
    assert "END OF TERMS AND CONDITIONS" in text
    assert PROJECT["license"] == "Apache-2.0"


def test_no_dependency_is_under_the_gpl_alone():
    waiting = [Requirement(text) for text in PROJECT["dependencies"]]
    seen = set()
    while waiting:
        requirement = waiting.pop()
        name = requirement.name.lower().replace("_", "-")
        if name in seen or (requirement.marker and not requirement.marker.evaluate({"extra": ""})):
            continue
        seen.add(name)
        installed = distribution(name)
        waiting += [Requirement(text) for text in installed.requires or []]
        about = installed.metadata
        choices = [text for text in about.get_all("Classifier", []) if text.startswith("License ::")]
        # Classifiers list alternatives (hidapi: BSD or GPL); an expression or a name stands for itself.
        choices = choices or [about.get("License-Expression") or (about.get("License") or "").split("\n")[0]]
        copyleft = [text for text in choices if re.search(r"\bA?GPL|(?<!Lesser )General Public", text)]
        assert len(copyleft) < len(choices), (name, choices)


def test_no_path_of_one_machine_is_in_the_tree():
    files = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    if files.returncode:
        pytest.skip("not a git checkout")
    for name in files.stdout.splitlines():
        path = ROOT / name
        if path.suffix in (".py", ".md", ".toml", ".json", ".yml") and path.is_file():
            home = re.search(r"(?<![\w.-])/(?:root|work)/\w+", path.read_text(errors="replace"))
            assert home is None, (name, home)
