"""The refinement from beginning to end: within its steps, its time, its marks, and never for worse."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_scene import MemoryScene

from relight.errors import RefineError
from relight.maps import render_maps
from relight.neural.refined import refine
from relight.neural.refined.refine import refine_solved
from relight.neural.stopwatch import Stopwatch
from relight.portrait import load_portrait


class Ticks:
    """A clock that ticks when it is looked at."""

    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        self.now_s += 0.5
        return self.now_s


def assert_same(first, second):
    for name, values in first.decoder.tensors().items():
        np.testing.assert_array_equal(second.decoder.tensors()[name], values, err_msg=name)
    assert first.decoder.settings() == second.decoder.settings()


@pytest.fixture(scope="module")
def refined(scene, dim, config):
    """What forty steps make of a solve whose lights are too dark."""
    told = []
    dim = replace(dim, info={**dim.info, "warnings": ["The solve has a word."]})
    portrait = refine_solved(scene, dim, config=config, seed=5, progress=lambda *each: told.append(each))
    return portrait, told


def test_the_portrait_has_the_network_and_says_how_it_came_about(refined, dim):
    portrait, told = refined
    facts = portrait.info["refinement"]
    assert (facts["steps"], facts["skipped_steps"]) == (40, 0)
    assert [step for step, _ in facts["held_out_loss"]] == [0, 20, 40]
    assert [step for step, _ in facts["held_out_db"]] == [0, 20, 40]
    assert len(facts["held_out_frames"]) == 2
    assert portrait.info["warnings"] == ["The solve has a word."]
    assert portrait.info["solver"] == dim.info["solver"]
    assert told[0] == ("refine", 0.0)
    assert told[-1] == ("refine", 1.0)
    assert len(portrait.decoder.descriptors) == len(portrait.points)
    for name in ("points", "normals_world", "albedo", "room_radiance"):
        np.testing.assert_array_equal(getattr(portrait, name), getattr(dim, name))


def test_held_out_frames_are_shown_better_than_by_the_solve(scene, refined, dim):
    portrait, _ = refined
    index = next(i for i in portrait.info["refinement"]["held_out_frames"] if not scene.views[i].flash)
    frame = scene.frames[index]
    errors = []
    for each in (dim, portrait):
        difference = render_maps(each, frame.camera).room_radiance.numpy() - frame.radiance
        errors.append(np.sqrt((difference[frame.hit] ** 2).mean()))
    assert errors[1] < 0.8 * errors[0]


def test_the_same_seed_gives_the_very_same_portrait(scene, dim, config, refined):
    assert_same(refine_solved(scene, dim, config=config, seed=5), refined[0])
    other = refine_solved(scene, dim, config=replace(config, steps=20), seed=6)
    assert not torch.equal(other.decoder.descriptors, refined[0].decoder.descriptors)


def test_it_is_saved_and_read_again(refined, tmp_path):
    refined[0].save(tmp_path)
    assert_same(load_portrait(tmp_path), refined[0])


@pytest.mark.parametrize("limit_s", [12.0, 39.0])
def test_a_fit_that_was_stopped_by_its_time_goes_on_to_the_very_same_portrait(
    scene, dim, config, tmp_path, refined, limit_s
):
    watch = Stopwatch(limit_s, clock=Ticks())
    part = refine_solved(scene, dim, config=config, seed=5, checkpoint=tmp_path, stopwatch=watch)
    stopped = part.info["refinement"]["steps"]
    assert 0 < stopped < 40
    assert stopped % config.check_every != 0
    # Early it has nothing yet, and is the solve.
    assert (part.decoder is None) == (stopped < 20)
    again = refine_solved(scene, dim, config=config, seed=5, checkpoint=tmp_path)
    assert_same(again, refined[0])
    facts, whole = (each.info["refinement"] for each in (again, refined[0]))
    assert facts["held_out_loss"] == whole["held_out_loss"]
    # A fit that has ended is not fitted on.
    ended = (tmp_path / "state.json").read_text()
    assert '"step": 40' in ended
    assert_same(refine_solved(scene, dim, config=config, seed=5, checkpoint=tmp_path), refined[0])
    assert (tmp_path / "state.json").read_text() == ended


def test_without_time_it_is_the_solve_and_that_is_said(scene, dim, config, tmp_path):
    portrait = refine_solved(scene, dim, config=config, seconds=0.0, checkpoint=tmp_path)
    assert portrait.decoder is None
    assert "had no time for 20 steps" in portrait.info["warnings"][-1]
    np.testing.assert_array_equal(portrait.albedo, dim.albedo)
    portrait.save(tmp_path / "portrait")


def test_a_network_that_makes_held_out_frames_worse_is_not_used(scene, solved, config, tmp_path):
    """A rate at which nothing can be learned: changes jump from bound to bound."""
    portrait = refine_solved(scene, solved, config=replace(config, rate=1.0))
    losses = [loss for _, loss in portrait.info["refinement"]["held_out_loss"]]
    assert min(losses[1:]) > losses[0]
    assert portrait.decoder is None
    assert "no better: this is the photometric solve" in portrait.info["warnings"][-1]
    np.testing.assert_array_equal(portrait.albedo, solved.albedo)
    portrait.save(tmp_path)


def test_a_state_that_was_better_once_is_the_one_that_is_kept(scene, dim, config, monkeypatch):
    """The network is spoiled after its first look: the portrait is that of the look."""
    advance = refine.RefinedFit.advance

    def spoiled(fit):
        if fit.step >= 20:
            with torch.no_grad():
                fit.network.unet.last.bias.fill_(-9.0)
        return advance(fit)

    short = refine_solved(scene, dim, config=config, stopwatch=Stopwatch(1e9))
    monkeypatch.setattr(refine.RefinedFit, "advance", spoiled)
    portrait = refine_solved(scene, dim, config=config)
    losses = [loss for _, loss in portrait.info["refinement"]["held_out_loss"]]
    assert losses[1] < losses[0] < losses[2]
    assert float(portrait.decoder.network.unet.last.bias.min()) > -1.0
    assert not torch.equal(portrait.decoder.descriptors, short.decoder.descriptors)


def test_it_ends_when_held_out_frames_get_no_better(scene, solved, config):
    settings = replace(config, rate=1.0, steps=400, check_every=5, patience=2)
    portrait = refine_solved(scene, solved, config=settings)
    told = portrait.info["refinement"]
    losses = [loss for _, loss in told["held_out_loss"]]
    assert told["steps"] == 5 * (len(losses) - 1) < 400
    # Two looks without gain, and not two before.
    assert min(losses[-2:]) >= min(losses[:-2])
    assert all(min(losses[k : k + 2]) < min(losses[:k]) for k in range(1, len(losses) - 2))


def test_a_fit_whose_loss_is_never_finite_ends_with_a_sentence(scene, solved, config):
    with pytest.raises(RefineError, match="no finite loss for 20 steps"):
        refine_solved(scene, solved, config=replace(config, rate=1e30))


def few(scene, most_lit):
    """The scene with some of its lit frames."""
    lit = [k for k, view in enumerate(scene.views) if view.flash][:most_lit]
    kept = [k for k, view in enumerate(scene.views) if not view.flash or k in lit]
    return MemoryScene([scene.frames[k] for k in kept], [scene.radiances[k] for k in kept], scene.points)


def test_with_too_few_frames_to_spare_it_goes_to_the_end_and_says_so(scene, dim, config, tmp_path):
    gainless = replace(dim, info={**dim.info, "flash_gains": []})
    portrait = refine_solved(few(scene, 4), gainless, config=config, checkpoint=tmp_path / "state")
    assert portrait.info["refinement"]["held_out_frames"] == []
    assert portrait.info["refinement"]["steps"] == 40
    assert portrait.decoder is not None
    assert "too few lit frames to spare" in portrait.info["warnings"][-1]
    again = refine_solved(few(scene, 4), gainless, config=config, checkpoint=tmp_path / "state")
    assert_same(again, portrait)


def test_held_out_frames_that_show_nothing_are_as_none(scene, dim, config):
    checked = {9, 10}
    radiances = [
        np.full_like(radiance, np.nan) if k in checked else radiance
        for k, radiance in enumerate(scene.radiances)
    ]
    broken = MemoryScene(scene.frames, radiances, scene.points)
    portrait = refine_solved(broken, dim, config=replace(config, steps=20))
    assert set(portrait.info["refinement"]["held_out_frames"]) == checked
    assert portrait.info["refinement"]["held_out_loss"] == []
    assert portrait.decoder is not None
    assert "nothing says" in portrait.info["warnings"][-1]


def test_at_marks_the_portrait_of_that_time_is_handed_over(scene, dim, config):
    marks = []
    watch = Stopwatch(
        marks_s=[3.0, 12.0, 1e9],
        at_mark=lambda mark_s, portrait: marks.append((mark_s, portrait)),
        clock=Ticks(),
    )
    refine_solved(scene, dim, config=replace(config, steps=30), stopwatch=watch)
    assert [mark for mark, _ in marks] == [3.0, 12.0]
    early, late = (portrait for _, portrait in marks)
    assert early.info["refinement"]["steps"] < 20 <= late.info["refinement"]["steps"]
    assert early.decoder is None
    assert late.decoder is not None
