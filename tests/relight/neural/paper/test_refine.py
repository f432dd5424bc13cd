"""The preset from beginning to end: within its steps, its time, its marks, and with or without a face."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from relight.errors import RefineError
from relight.neural.paper.refine import refine_paper
from relight.neural.stopwatch import Stopwatch
from relight.neural.vgg import Vgg16


class Steps:
    """A clock that ticks when it is looked at."""

    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        self.now_s += 0.5
        return self.now_s


def test_the_portrait_has_the_network_and_says_how_it_came_about(scene, solved, config):
    told = []
    solved = replace(solved, info={**solved.info, "warnings": ["The solve has a word."]})
    portrait = refine_paper(scene, solved, config=config, progress=lambda *each: told.append(each))
    assert portrait.decoder is not None
    assert len(portrait.decoder.descriptors) == len(portrait.points)
    facts = portrait.info["refinement"]
    assert (facts["steps"], facts["skipped_steps"], facts["perceptual"]) == (6, 0, "weight-free")
    assert facts["held_out_db"][-1][0] == 6
    said = " ".join(portrait.info["warnings"])
    assert "VGG-16's weights were not given (--vgg FILE)" in said
    assert "No face is known" in said
    assert "The solve has a word." in said
    assert told[0] == ("paper", 0.0)
    assert told[-1] == ("paper", 1.0)
    assert portrait.info["solver"] == solved.info["solver"]


def test_a_fit_that_was_stopped_by_its_time_goes_on_to_the_very_same_portrait(
    scene, solved, config, tmp_path
):
    whole = refine_paper(scene, solved, config=config, seed=5)
    watch = Stopwatch(2.0, clock=Steps())
    part = refine_paper(scene, solved, config=config, seed=5, checkpoint=tmp_path, stopwatch=watch)
    assert 0 < part.info["refinement"]["steps"] < 6
    assert f"after {part.info['refinement']['steps']} of 6 steps" in " ".join(part.info["warnings"])
    again = refine_paper(scene, solved, config=config, seed=5, checkpoint=tmp_path)
    for name, values in whole.decoder.tensors().items():
        np.testing.assert_array_equal(again.decoder.tensors()[name], values, err_msg=name)
    np.testing.assert_array_equal(again.albedo, whole.albedo)
    # A fit that has ended is not fitted on.
    ended = (tmp_path / "state.json").read_text()
    assert '"step": 6' in ended
    assert refine_paper(scene, solved, config=config, checkpoint=tmp_path).info["refinement"]["steps"] == 6
    assert (tmp_path / "state.json").read_text() == ended


def test_without_time_for_a_step_it_is_the_solve_and_that_is_said(scene, solved, config):
    portrait = refine_paper(scene, solved, config=config, seconds=0.0)
    assert portrait.decoder is None
    assert "no time for a step" in portrait.info["warnings"][-1]
    np.testing.assert_array_equal(portrait.albedo, solved.albedo)


def test_at_marks_the_portrait_of_that_time_is_handed_over(scene, solved, config):
    marks = []
    watch = Stopwatch(
        marks_s=[0.6, 2.1, 1e9],
        at_mark=lambda mark_s, portrait: marks.append((mark_s, portrait.info["refinement"]["steps"])),
        clock=Steps(),
    )
    refine_paper(scene, solved, config=config, stopwatch=watch)
    assert [mark for mark, _ in marks] == [0.6, 2.1]
    assert 0 < marks[0][1] < marks[1][1] <= 6


def test_weights_of_vgg_are_used_and_a_missing_file_is_said(scene, solved, config, tmp_path):
    torch.manual_seed(0)
    save_file(Vgg16().state_dict(), tmp_path / "vgg.safetensors")
    settings = replace(config, vgg=str(tmp_path / "vgg.safetensors"), steps=1)
    portrait = refine_paper(scene, solved, config=settings)
    assert portrait.info["refinement"]["perceptual"] == "VGG-16"
    assert not any("VGG" in sentence for sentence in portrait.info["warnings"])
    with pytest.raises(RefineError, match="There is no file"):
        refine_paper(scene, solved, config=replace(config, vgg=str(tmp_path / "none.pth")))
