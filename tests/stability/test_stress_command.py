"""`relight stress`: its table, its file, its exit code."""

import json

import pytest
import torch

from relight.cli import main
from relight.stress import suite
from relight.stress.case import Case, Measured, Stage


def test_the_table_has_a_line_a_case_and_one_a_stage(capsys, tmp_path):
    file = tmp_path / "stress.json"
    assert main(["stress", "--only", "PULL-PUSH: ", "--only", "descriptors: one", "--json", str(file)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith("pull-push: ") for line in lines) == 6
    assert sum(line.startswith("descriptors: ") for line in lines) == 1
    assert "| pull-push | 6 | 6 | 0 | 0 | 0 |" in "\n".join(lines)
    verdicts = json.loads(file.read_text())["verdicts"]
    assert len(verdicts) == 7 * 3
    assert {verdict["outcome"] for verdict in verdicts} == {"finite"}
    assert {verdict["dtype"] for verdict in verdicts} == {"float64", "float32", "bfloat16"}


def test_one_precision_can_be_asked_for(capsys, tmp_path):
    file = tmp_path / "stress.json"
    assert main(["stress", "--only", "harmonics", "--dtype", "float32", "--json", str(file)]) == 0
    assert {verdict["dtype"] for verdict in json.loads(file.read_text())["verdicts"]} == {"float32"}
    capsys.readouterr()


def test_a_name_that_no_case_has_is_refused_with_the_known_ones(capsys):
    assert main(["stress", "--only", "unheard of"]) == 1
    assert "'unheard of'" in (said := capsys.readouterr().err)
    assert "pull-push" in said


def test_a_failure_is_told_and_is_the_exit_code(capsys, monkeypatch, tmp_path):
    stage = Stage("a stage", (torch.float32,), "so")
    bad = Case(
        stage, "an input", lambda dtype: Measured({"x": torch.tensor([torch.nan])}, error=float("nan"))
    )
    monkeypatch.setattr(suite, "all_cases", lambda: (bad,))
    file = tmp_path / "stress.json"
    assert main(["stress", "--json", str(file)]) == 1
    told = capsys.readouterr()
    assert "values not finite: x (1 of 1)" in told.out
    assert '1 of 1 cases failed; the first is "a stage: an input".' in told.err
    (verdict,) = json.loads(file.read_text())["verdicts"]
    assert (verdict["outcome"], verdict["error"]) == ("FAILED", None)


@pytest.mark.parametrize("quick", [True, False])
def test_long_cases_can_be_left_out(quick, capsys, monkeypatch):
    stage = Stage("a stage", (torch.float32,), "so")
    cases = tuple(
        Case(stage, str(k), lambda dtype: Measured({"x": torch.ones(1)}), long=bool(k)) for k in range(2)
    )
    monkeypatch.setattr(suite, "all_cases", lambda: cases)
    assert main(["stress", *(["--quick"] if quick else [])]) == 0
    assert ("a stage: 1" in capsys.readouterr().out) is not quick
