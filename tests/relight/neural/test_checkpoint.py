"""A state comes back as it was written; of several the last counts; a damaged one is refused."""

import json

import pytest
import torch

from relight.errors import RefineError
from relight.neural.checkpoint import load_state, save_state


def tensors(value):
    return {"a": torch.full((3, 2), float(value)), "count": torch.tensor(7), "bytes": torch.arange(4).byte()}


def test_a_state_comes_back_as_it_was(tmp_path):
    save_state(tmp_path / "new", 12, tensors(0.1), {"step": 12, "text": "Grüße"})
    found, content = load_state(tmp_path / "new", "cpu")
    assert content == {"step": 12, "text": "Grüße"}
    for name, values in tensors(0.1).items():
        assert torch.equal(found[name], values)
        assert found[name].dtype == values.dtype


def test_the_last_state_counts_and_the_one_before_is_gone(tmp_path):
    for step in (1, 2):
        save_state(tmp_path, step, tensors(step), {"step": step})
    assert load_state(tmp_path, "cpu")[1] == {"step": 2}
    assert len(list(tmp_path.glob("*.safetensors"))) == 1


def test_where_none_was_written_there_is_none(tmp_path):
    assert load_state(tmp_path, "cpu") is None
    assert load_state(tmp_path / "nowhere", "cpu") is None


def test_a_power_cut_before_the_last_line_leaves_the_state_before(tmp_path):
    save_state(tmp_path, 1, tensors(1), {"step": 1})
    first = (tmp_path / "state.json").read_text()
    save_state(tmp_path, 2, tensors(2), {"step": 2})
    # As it was after the second state's tensors, before its state.json; the first state's are still there.
    (tmp_path / "state-000001.safetensors").write_bytes((tmp_path / "state-000002.safetensors").read_bytes())
    (tmp_path / "state.json").write_text(first)
    assert load_state(tmp_path, "cpu")[1] == {"step": 1}


@pytest.mark.parametrize("damage", ["{", '{"schema": 9}', "[]", '{"schema": 1, "tensors": "none"}'])
def test_a_damaged_state_is_refused_with_what_to_do(tmp_path, damage):
    save_state(tmp_path, 1, tensors(1), {})
    (tmp_path / "state.json").write_text(damage)
    with pytest.raises(RefineError, match="remove the folder, or fit with --fresh"):
        load_state(tmp_path, "cpu")


def test_missing_tensors_are_refused(tmp_path):
    save_state(tmp_path, 1, tensors(1), {})
    assert json.loads((tmp_path / "state.json").read_text())["tensors"] == "state-000001.safetensors"
    (tmp_path / "state-000001.safetensors").write_bytes(b"scrap")
    with pytest.raises(RefineError, match="cannot be read"):
        load_state(tmp_path, "cpu")
