"""The fit learns, is the same again from the same seed, and goes on as if it had never been stopped."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic_scene import Head, MemoryScene, photograph

from relight.errors import PlanError, RefineError
from relight.maps import render_maps
from relight.neural.refined.config import RefinedConfig, balanced_config, fast_config
from relight.neural.refined.fitting import RefinedFit


def begun(scene, solved, config, seed=0):
    return RefinedFit(scene, solved, config, seed)


def steps(fit, count):
    return [sum(fit.advance().values()) for _ in range(count)]


def assert_same(first, second):
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def with_radiance(scene, of):
    """The scene with frames whose radiance is `of(number, radiance)`."""
    radiances = [of(k, radiance) for k, radiance in enumerate(scene.radiances)]
    return MemoryScene(scene.frames, radiances, scene.points)


def test_what_the_lights_lack_is_learned_where_it_was_not_fitted(scene, dim, config):
    fit = begun(scene, dim, config)
    before = fit.check()
    first = steps(fit, 4)
    steps(fit, 56)
    last = steps(fit, 4)
    after = fit.check()
    assert np.mean(last) < 0.6 * np.mean(first)
    assert after[0] > before[0] + 3.0
    assert after[1] < 0.6 * before[1]
    assert [step for step, _, _ in fit.checks] == [0, 64]
    assert fit.skipped == 0
    # The room and the flash were both too dark by a fifth, and that is where it went: not into the albedo.
    portrait = replace(dim, decoder=fit.decoder(fit.state()))
    camera = next(view.camera for view in fit.checked if view.flash)
    maps, plain = render_maps(portrait, camera), render_maps(dim, camera)
    on = (maps.mask > 0.9) & (plain.confidence > 0.3)
    assert float(maps.flash_gain[on].median()) > 1.05
    assert float((maps.room_radiance / plain.room_radiance)[on].median()) > 1.05
    assert float((maps.albedo / plain.albedo)[on].median()) == pytest.approx(1.0, abs=0.02)


def test_the_first_look_is_at_the_solve_as_it_is(scene, solved, config):
    """PSNR against one that is put together from maps and formulas, without the fit's code."""
    fit = begun(scene, solved, config)
    ratio, _ = fit.check()
    expected = []
    for view in fit.checked:
        if view.flash:
            continue
        maps, frame = render_maps(solved, view.camera), scene.frames[view.index]
        inside = frame.hit & (frame.radiance.max(axis=-1) < scene.clip)

        def srgb(linear):
            linear = np.clip(np.asarray(linear, np.float64), 0, 1)
            return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)

        error = (srgb(maps.room_radiance) - srgb(frame.radiance))[inside]
        expected.append(-10 * np.log10((error**2).mean()))
    unlit = begun(scene, solved, config)
    unlit.checked = tuple(view for view in fit.checked if not view.flash)
    # Frames are kept in half precision.
    assert unlit.check()[0] == pytest.approx(np.mean(expected), abs=0.3)
    assert ratio > 25


def test_held_out_frames_are_not_drawn(scene, solved, config):
    fit = begun(scene, solved, config)
    assert len(fit.checked) == 2
    assert not {view.index for view in fit.checked} & {view.index for view in fit.fitted}
    black = {view.index for view in fit.checked}
    other = with_radiance(scene, lambda k, radiance: np.zeros_like(radiance) if k in black else radiance)
    changed = begun(other, solved, config)
    for each in (fit, changed):
        steps(each, 4)
    assert_same(fit.state(), changed.state())


def test_the_same_seed_gives_the_same_and_another_another(scene, solved, config):
    states = []
    for seed in (3, 3, 4):
        fit = begun(scene, solved, config, seed)
        steps(fit, 3)
        states.append(fit.state())
    assert_same(states[0], states[1])
    assert not torch.equal(
        states[0]["network.unet.start.conv.weight"], states[2]["network.unet.start.conv.weight"]
    )


def test_beginning_a_fit_takes_nothing_from_chance_elsewhere(scene, solved, config):
    before = torch.random.get_rng_state()
    steps(begun(scene, solved, config), 1)
    np.testing.assert_array_equal(torch.random.get_rng_state(), before)


@pytest.mark.parametrize("settings", [{}, {"exposures": False}, {"descriptors": 0}])
def test_a_fit_that_was_stopped_goes_on_to_the_very_same_result(scene, solved, config, tmp_path, settings):
    config = replace(config, **settings)
    whole = begun(scene, solved, config)
    whole.check()
    steps(whole, 6)
    before = begun(scene, solved, config)
    before.check()
    steps(before, 3)
    before.save(tmp_path, before.state())
    after = begun(scene, solved, config, seed=99)  # chance goes on from the checkpoint, not from the seed
    went_on, best = after.resume(tmp_path)
    assert went_on
    assert_same(best, before.state())
    assert after.step == 3
    assert after.checks == before.checks
    steps(after, 3)
    assert_same(after.state(), whole.state())


def test_a_checkpoint_of_another_configuration_is_left_alone(scene, solved, config, tmp_path):
    fit = begun(scene, solved, config)
    steps(fit, 1)
    fit.save(tmp_path, None)
    assert begun(scene, solved, config).resume(tmp_path) == (True, None)
    assert begun(scene, solved, replace(config, rate=2e-3)).resume(tmp_path) == (False, None)
    assert begun(scene, solved, config).resume(tmp_path / "nowhere") == (False, None)


def test_a_checkpoint_of_another_cloud_is_refused(scene, solved, config, tmp_path):
    fit = begun(scene, solved, config)
    steps(fit, 1)
    fit.save(tmp_path, None)
    fewer = solved.subset(torch.arange(len(solved.points)) % 2 == 0)
    with pytest.raises(RefineError, match="not of this fit"):
        begun(scene, fewer, config).resume(tmp_path)


def test_the_decoder_does_not_change_when_the_fit_goes_on(scene, solved, config):
    fit = begun(scene, solved, config)
    steps(fit, 2)
    portrait = replace(solved, decoder=fit.decoder(fit.state()))
    camera = scene.views[0].camera
    before = render_maps(portrait, camera).room_radiance
    steps(fit, 1)
    np.testing.assert_array_equal(render_maps(portrait, camera).room_radiance, before)


def test_what_is_fitted_is_what_the_decoder_shows(scene, dim, config):
    """Of a whole frame, the decoder's maps under the captured light are the fit's own picture."""
    fit = begun(scene, dim, replace(config, exposures=False))
    steps(fit, 10)
    fit.checked = tuple(view for view in fit.checked if not view.flash)
    ratio, _ = fit.check()
    (view,) = fit.checked
    maps = render_maps(replace(dim, decoder=fit.decoder(fit.state())), view.camera)
    frame = scene.frames[view.index]
    linear = [np.clip(np.asarray(each, np.float64), 0, 1) for each in (maps.room_radiance, frame.radiance)]
    first, second = (1.055 * x.clip(0.0031308) ** (1 / 2.4) - 0.055 for x in linear)
    error = (first - second)[frame.hit & (frame.radiance.max(axis=-1) < scene.clip)]
    # The box about the subject begins elsewhere than the frame, and the frame is kept in half precision.
    assert -10 * np.log10((error**2).mean()) == pytest.approx(ratio, abs=0.3)


class Spoiled(RefinedFit):
    """A fit whose loss can be made NaN."""

    spoiled = False

    def _terms(self, image, layers, target):
        terms = super()._terms(image, layers, target)
        return {name: value * torch.nan for name, value in terms.items()} if self.spoiled else terms


@pytest.mark.parametrize("exposures", [True, False])
def test_a_step_without_a_finite_loss_is_skipped_and_leaves_nothing_behind(scene, solved, config, exposures):
    fit = Spoiled(scene, solved, replace(config, exposures=exposures), 0)
    steps(fit, 1)
    before = fit.state()
    fit.spoiled = True
    fit.advance()
    assert (fit.step, fit.skipped) == (2, 1)
    assert_same(fit.state(), before)
    fit.spoiled = False
    fit.advance()
    assert fit.skipped == 1
    assert not torch.equal(fit.state()["network.unet.last.weight"], before["network.unet.last.weight"])


def test_many_steps_without_a_finite_loss_end_the_fit_and_looks_at_them_do_not_count(scene, solved, config):
    fit = Spoiled(scene, solved, config, 0)
    fit.spoiled = True
    steps(fit, 19)
    assert fit.check() is None
    assert fit.checks == []
    with pytest.raises(RefineError, match="no finite loss for 20 steps on end"):
        fit.advance()


def test_frames_that_are_black_white_or_broken_are_fitted_without_a_complaint(scene, solved, config):
    for value in (0.0, 2.0, np.nan, np.inf):
        other = with_radiance(scene, lambda _, radiance: np.full_like(radiance, value))  # noqa: B023
        fit = begun(other, solved, config)
        fit.check()
        steps(fit, 3)
        assert fit.skipped == 0
        assert all(bool(values.isfinite().all()) for values in fit.state().values())


def test_one_broken_frame_is_not_learned_from(scene, solved, config):
    broken = with_radiance(scene, lambda k, r: np.full_like(r, np.nan) if k == 4 else r)
    fit = begun(broken, solved, config)
    steps(fit, 12)
    assert fit.skipped == 0
    assert all(bool(values.isfinite().all()) for values in fit.state().values())


def test_patches_larger_than_the_frames_and_frames_without_masks_are_fitted(scene, dim, config):
    unmasked = replace(scene, with_masks=False)
    for each, settings in ((scene, {"patch": 256}), (unmasked, {})):
        fit = begun(each, dim, replace(config, **settings))
        before = fit.check()
        steps(fit, 30)
        assert fit.check()[1] < before[1]
        assert fit.skipped == 0


def test_frames_that_are_not_square_and_of_several_sizes_are_fitted(scene, solved, config):
    frames = []
    for k, frame in enumerate(scene.frames):
        intrinsics = frame.camera.K.copy()
        intrinsics[0, 2] -= 7 + k % 3
        width = 52 - 2 * (7 + k % 3)
        cut = slice(7 + k % 3, 52 - 7 - k % 3)
        camera = replace(frame.camera, width=width, K=intrinsics)
        images = {name: getattr(frame, name)[:, cut] for name in ("hit", "points", "normals", "radiance")}
        frames.append(replace(frame, camera=camera, **images))
    narrow = MemoryScene(frames, [frame.radiance for frame in frames], scene.points)
    fit = begun(narrow, solved, replace(config, patch=64))
    fit.check()
    steps(fit, 4)
    assert fit.skipped == 0
    assert fit.checks[0][1] > 25


def test_exposures_take_what_is_of_one_frame_alone(scene, solved, config):
    """Every third frame is brighter by 5 %: with exposures of their own the network need not explain it."""
    uneven = with_radiance(scene, lambda k, radiance: radiance * (1.05 if k % 3 == 0 else 1.0))
    fit = begun(uneven, solved, config)
    steps(fit, 40)
    learned = fit._exposures.detach().mean(dim=1)
    fitted = [view.index for view in fit.fitted if not view.flash]
    brighter = torch.tensor([bool(index % 3 == 0) for index in fitted])
    assert float(learned[fitted][brighter].mean()) > float(learned[fitted][~brighter].mean()) + 1e-4
    for view in fit.checked:  # no frame that is not fitted gets one
        assert float(learned[view.index]) == 0.0
    off = begun(uneven, solved, replace(config, exposures=False))
    steps(off, 3)
    assert not off._exposures.any()


def test_in_bfloat16_it_learns_the_same_but_for_rounding(scene, dim, config):
    losses = []
    for precision in ("float32", "bfloat16"):
        fit = begun(scene, dim, replace(config, precision=precision))
        losses.append(steps(fit, 4))
        assert fit.descriptors.dtype == torch.float32
    # bfloat16 has 8 bits: a third of a percent a rounding, some of which add up.
    np.testing.assert_allclose(losses[1], losses[0], rtol=0.05)


def test_flash_frames_have_the_gains_that_the_solve_found(scene, config, solved):
    lit = [view.index for view in scene.views if view.flash]
    gains = [1.0 - 0.4 * (k % 2) for k in range(len(lit))]
    drooping = with_radiance(
        scene,
        lambda k, radiance: (
            photograph(Head(), scene.frames[k].camera, gains[lit.index(k)]).radiance if k in lit else radiance
        ),
    )
    with_gains = replace(solved, info={**solved.info, "flash_gains": gains})
    without = replace(solved, info={**solved.info, "flash_gains": []})
    ratios = []
    for portrait in (with_gains, without):
        fit = begun(drooping, portrait, config)
        fit.checked = tuple(view for view in scene.views if view.index in lit[1::2])
        ratios.append(fit.check()[0])
    assert ratios[0] > ratios[1] + 3.0


@pytest.mark.parametrize(
    "settings",
    [
        {"patch": 36},
        {"patch": 4},
        {"patch": 0},
        {"precision": "half"},
        {"steps": 0},
        {"check_every": 0},
        {"patience": 0},
        {"descriptors": -1},
        {"rate": 0.0},
        {"descriptor_rate": -1.0},
        {"rate": float("nan")},
        {"widths": (16, 2, 32, 48)},
        {"widths": (0, 24, 32, 48)},
        {"widths": ()},
    ],
)
def test_impossible_settings_are_refused(settings):
    for make in (RefinedConfig, fast_config, balanced_config):
        with pytest.raises(PlanError):
            make(**settings)


def test_what_is_set_of_a_preset_takes_the_place_of_its_own():
    assert balanced_config(steps=7).steps == 7
    assert balanced_config().steps > fast_config().steps
