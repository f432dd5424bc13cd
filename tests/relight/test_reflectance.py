"""The reflectance model against its formula written out, its limits, and its recovery from noisy samples."""

import numpy as np
import pytest
import torch
from analytic_scene import C_FLASH, Head

from relight.reflectance import GRAZING, Reflectance, fit_reflectance, gloss_lobe

SKIN = Reflectance(retro=0.5, alpha=0.25, f0=0.04)


def unit(*shape, seed=0, dtype=torch.float64):
    random = torch.Generator().manual_seed(seed)
    return torch.nn.functional.normalize(torch.randn(*shape, 3, generator=random, dtype=dtype), dim=-1)


def samples(reflectance, noise, points=4000, frames=12, seed=0):
    """Cosines, responses and weights of points with albedos 0.2..0.7 under lights from all around."""
    random = np.random.default_rng(seed)
    cosine = random.uniform(-0.2, 1.0, (frames, points))
    albedo = random.uniform(0.2, 0.7, points)
    c = np.clip(cosine, 0, 1)
    a2, k = reflectance.alpha**2, reflectance.alpha / 2
    lobe = a2 * c / (4 * (c * (1 - k) + k) ** 2 * (c * c * (a2 - 1) + 1) ** 2)
    response = albedo * c * (1 + reflectance.retro * (1 - c) ** 5) ** 2 + reflectance.f0 * lobe
    response += noise * random.normal(size=response.shape)
    weight = (cosine > 0).astype(np.float64)
    return tuple(torch.tensor(values, dtype=torch.float32) for values in (cosine, response, weight))


def test_seen_along_the_light_the_model_is_its_single_angle_form():
    normals, directions = unit(200), unit(200, seed=1)
    albedo = torch.rand(200, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    cosine = (normals * directions).sum(dim=1)
    expected = albedo * SKIN.diffuse(cosine)[:, None] + SKIN.gloss(cosine)[:, None]
    np.testing.assert_allclose(SKIN.response(albedo, normals, directions, directions), expected, rtol=1e-9)


def test_model_is_burleys_diffuse_and_ggx_for_any_directions():
    head = Head(retro=0.5, alpha=0.25, f0=0.04)
    normals = unit(200)
    flash, eye = 3 * unit(1, seed=1)[0].numpy(), 3 * unit(1, seed=2)[0].numpy()
    expected = head.flash_radiance(np.zeros((200, 3)), normals.numpy(), 0.4, flash, eye) / C_FLASH * 9
    to_light, to_view = (torch.tensor(at / 3).expand(200, 3) for at in (flash, eye))
    response = SKIN.response(torch.full((200, 3), 0.4, dtype=torch.float64), normals, to_light, to_view)
    # Where the eye is behind the surface nothing is seen, and both are arbitrary.
    front = (normals * to_view).sum(dim=1) > 0
    np.testing.assert_allclose(response[front], expected.repeat(3, axis=1)[front], rtol=1e-9)


def test_without_gloss_and_retro_reflection_it_is_lambert():
    normals, to_light, to_view = unit(50), unit(50, seed=1), unit(50, seed=2)
    response = Reflectance().response(torch.ones(50, 3, dtype=torch.float64), normals, to_light, to_view)
    cosine = (normals * to_light).sum(dim=1).clamp(min=0)
    np.testing.assert_allclose(response, cosine[:, None].expand(50, 3), rtol=1e-12)


def test_no_light_comes_from_behind():
    cosine = torch.tensor([-1.0, -0.5, 0.0])
    assert not SKIN.diffuse(cosine).any()
    assert not gloss_lobe(cosine, 0.25).any()
    up, down = torch.tensor([[0.0, 0, 1]]), torch.tensor([[0.0, 0, -1]])
    assert not SKIN.response(torch.ones(1, 3), up, down, up).any()


@pytest.mark.parametrize("reflectance", [Reflectance(), SKIN, Reflectance(0.75, 0.08, 1.0)])
def test_singular_directions_are_finite_with_finite_gradients(reflectance):
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    side, zero = torch.tensor([1.0, 0, 0], dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    cases = [
        (up, up, up),
        (up, up, -up),
        (up, side, -side),
        (up, side, side),
        (zero, up, side),
        (up, zero, zero),
    ]
    parts = [torch.stack([case[k] for case in cases]).requires_grad_() for k in range(3)]
    albedo = torch.full((len(cases), 3), 0.5, dtype=torch.float64, requires_grad=True)
    response = reflectance.response(albedo, *parts)
    assert response.isfinite().all()
    assert not response[4].any()  # a zero normal is no known surface
    response.sum().backward()
    for part in (*parts, albedo):  # a matte subject does not ask for the view
        assert part.grad is None or part.grad.isfinite().all()


def test_gradients_are_right():
    normals, to_light, to_view = (unit(20, seed=seed) for seed in range(3))
    # Away from the clamps at the horizon and at the front, where the derivative jumps.
    for part in (to_light, to_view):
        part *= (normals * part).sum(dim=1, keepdim=True).sign()
    inputs = [torch.rand(20, 3, dtype=torch.float64), normals, to_light, to_view]
    assert torch.autograd.gradcheck(SKIN.response, [part.requires_grad_() for part in inputs])


@pytest.mark.parametrize(
    ("truth", "error"),
    [
        # On the grid from which the search goes on.
        (Reflectance(0.5, 0.25, 0.05), 0.02),
        (Reflectance(0.25, 0.35, 0.08), 0.02),
        (Reflectance(0.0, 0.18, 0.03), 0.02),
        # Between its steps of 0.25 in retro and 30 to 50 % in alpha, which are made eight times finer.
        (Reflectance(0.4, 0.3, 0.05), 0.07),
        (Reflectance(0.6, 0.21, 0.05), 0.07),
        (Reflectance(0.0, 0.42, 0.08), 0.07),
    ],
)
def test_truth_is_recovered_from_noisy_samples(truth, error):
    fitted = fit_reflectance(*samples(truth, noise=0.01))
    assert fitted.alpha == pytest.approx(truth.alpha, rel=error)
    assert fitted.retro == pytest.approx(truth.retro, abs=error)
    # f0 is one number from some 30,000 samples of noise 0.01, under a lobe of which 0.3 (rms) is left when
    # albedo has explained what it can: 0.01 / sqrt(30,000) / 0.3 = 0.0002; five times that. A lobe that is a
    # little wider is lower by twice as much.
    assert fitted.f0 == pytest.approx(
        truth.f0, abs=0.001 + 2.0 * abs(fitted.alpha / truth.alpha - 1.0) * truth.f0
    )


def test_a_matte_subject_is_found_matte():
    fitted = fit_reflectance(*samples(Reflectance(), noise=0.01))
    assert fitted.retro == 0
    # The widest lobe is hardest to tell from albedo: 0.27 of it is left, of which noise makes 0.0002 and the
    # points' own f0, never negative, ten times that.
    assert fitted.f0 < 0.004


def test_a_tenth_of_wrong_samples_does_not_change_the_fit():
    cosine, response, weight = samples(SKIN, noise=0.01)
    wrong = torch.rand(response.shape, generator=torch.Generator().manual_seed(0)) < 0.1
    fitted = fit_reflectance(cosine, torch.where(wrong, 0.0, response), weight)  # in shadow
    assert fitted.alpha == pytest.approx(SKIN.alpha, rel=0.1)
    assert fitted.retro == pytest.approx(SKIN.retro, abs=0.1)
    assert fitted.f0 == pytest.approx(SKIN.f0, rel=0.2)  # less than between the steps of the grid of alpha


def test_samples_that_say_nothing_leave_lambert():
    cosine, response, weight = samples(SKIN, noise=0.0, points=50)
    for nothing in (weight * 0, weight * (torch.arange(12) < 2)[:, None], weight * (cosine < GRAZING)):
        assert fit_reflectance(cosine, response, nothing) == Reflectance()


@pytest.mark.parametrize("level", [0.0, 1e-6, 1e6])
def test_constant_responses_give_finite_numbers(level):
    cosine, response, weight = samples(SKIN, noise=0.0, points=50)
    fitted = fit_reflectance(cosine, torch.full_like(response, level), weight)
    assert np.isfinite([fitted.retro, fitted.alpha, fitted.f0]).all()
    assert fitted.f0 >= 0
