"""Lights against their formulas written out plainly, with shadows, gradients and the singular points."""

import math
from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from analytic_scene import looking_at

from capture.cameras import Camera
from relight.environment import DiffuseIrradiance
from relight.lamp import Lamp
from relight.lighting import (
    CapturedLight,
    DirectionalLight,
    EnvironmentLight,
    FlashLight,
    Light,
    PointLight,
    RoomLight,
    SphericalHarmonicsLight,
    shade,
)
from relight.panorama import lat_long_directions, lat_long_solid_angles, panorama_to_sh
from relight.reflectance import Reflectance
from relight.spherical_harmonics import rotation_about_up, sh_irradiance
from relight.surface import MIN_DISTANCE_M

DOUBLE = torch.float64
C_ROOM, C_FLASH = (0.9, 1.0, 1.1), (0.16, 0.15, 0.14)
OFFSET = (0.013, -0.007, 0.002)


@dataclass(frozen=True)
class FlatMaps:
    albedo: torch.Tensor
    normals_world: torch.Tensor
    shading: torch.Tensor
    mask: torch.Tensor
    points_world: torch.Tensor


def random_maps(*shape, dtype=DOUBLE, seed=0):
    """Points within 10 cm of the origin, facing anywhere; every other one outside the mask."""
    random = torch.Generator().manual_seed(seed)
    count = math.prod(shape)
    normals = torch.nn.functional.normalize(torch.randn(count, 3, generator=random, dtype=DOUBLE), dim=-1)
    mask = (torch.arange(count) % 2).to(DOUBLE)
    maps = FlatMaps(
        albedo=torch.rand(count, 3, generator=random, dtype=DOUBLE),
        normals_world=normals,
        shading=torch.rand(count, generator=random, dtype=DOUBLE),
        mask=mask,
        points_world=0.1 * torch.rand(count, 3, generator=random, dtype=DOUBLE),
    )
    return FlatMaps(
        **{name: value.to(dtype).reshape(*shape, *value.shape[1:]) for name, value in vars(maps).items()}
    )


def with_fields(maps, **fields):
    """The maps with fields that only some of them have."""
    return SimpleNamespace(**vars(maps), **fields)


def one_point(normal, point=(0.0, 0.0, 0.0), albedo=1.0, dtype=DOUBLE):
    return FlatMaps(
        albedo=torch.full((1, 3), albedo, dtype=dtype),
        normals_world=torch.tensor([normal], dtype=dtype),
        shading=torch.ones(1, dtype=dtype),
        mask=torch.ones(1, dtype=dtype),
        points_world=torch.tensor([point], dtype=dtype),
    )


def camera(flash=1):
    angle = 0.7
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = [
        [math.cos(angle), 0.0, -math.sin(angle)],
        [0.0, 1.0, 0.0],
        [math.sin(angle), 0.0, math.cos(angle)],
    ]
    cam_from_world[:3, 3] = (0.05, -0.1, 0.6)
    intrinsics = np.array([[500.0, 0, 8], [0, 500.0, 6], [0, 0, 1]])
    return Camera("0010", 16, 12, intrinsics, cam_from_world, np.zeros(0), flash)


def capture(**changes):
    return {"camera": camera(), "c_room": C_ROOM, "c_flash": C_FLASH, "flash_offset_cam_m": OFFSET, **changes}


def plain(maps, radiance_of):
    """A formula, point by point, where the mask is above 0."""
    expected = np.zeros((maps.mask.numel(), 3))
    flat = {name: value.reshape(maps.mask.numel(), -1).numpy() for name, value in vars(maps).items()}
    for i in np.nonzero(flat["mask"][:, 0])[0]:
        values = (flat[name][i] for name in ("albedo", "normals_world", "shading", "points_world"))
        expected[i] = radiance_of(*values)
    return expected.reshape(*maps.mask.shape, 3)


def lambert(normal, point, position):
    towards = np.asarray(position) - point
    distance = np.linalg.norm(towards)
    return max(0.0, normal @ towards / distance) / distance**2


def flash_position():
    pose = camera().cam_from_world
    return np.linalg.inv(pose)[:3, :3] @ (np.array(OFFSET) - pose[:3, 3])


class HalfVisible:
    """A visibility that halves everything, and says which lights it was asked for."""

    def __init__(self, shape, has_environment=True):
        self.half = torch.full(shape, 0.5)
        self.has_environment = has_environment
        self.asked = []

    def point(self, position_world, radius=0.0):
        self.asked.append(position_world)
        return self.half

    def directional(self, to_light, angle_rad=0.0):
        self.asked.append(to_light)
        return self.half

    def environment(self, directions, irradiances):
        self.asked.append(directions)
        channels = irradiances.shape[1]
        return self.half[..., None].expand(*self.half.shape, channels) if self.has_environment else None

    def indirect(self, light, arriving):
        return None


def panorama():
    random = np.random.default_rng(2)
    values = random.uniform(0.0, 0.3, size=(32, 64, 3))
    values[8, 40] = (40.0, 30.0, 20.0)
    return values.astype(np.float32)


@pytest.mark.parametrize("shape", [(7,), (4, 6)])
def test_captured_light_is_the_papers_sum_for_maps_and_for_points(shape):
    maps = random_maps(*shape)
    room = plain(maps, lambda albedo, normal, shading, point: albedo * C_ROOM * shading)
    flash = plain(
        maps,
        lambda albedo, normal, shading, point: albedo * C_FLASH * lambert(normal, point, flash_position()),
    )
    # Double precision throughout.
    np.testing.assert_allclose(shade(CapturedLight(), maps, **capture()), room + flash, atol=1e-12)
    np.testing.assert_allclose(shade(CapturedLight(), maps, **capture(flash=0)), room, atol=1e-12)
    np.testing.assert_allclose(shade(RoomLight(), maps, **capture()), room, atol=1e-12)
    np.testing.assert_allclose(shade(FlashLight(), maps, **capture(flash=0)), flash, atol=1e-12)
    np.testing.assert_allclose(shade(RoomLight() + FlashLight(), maps, **capture()), room + flash, atol=1e-12)


def test_flash_flag_is_the_cameras_own_and_an_unknown_one_counts_as_off():
    maps = random_maps(5)
    room = shade(RoomLight(), maps, **capture())
    assert not torch.equal(shade(CapturedLight(), maps, **capture(camera=camera(flash=1))), room)
    for flash in (0, None):
        assert torch.equal(shade(CapturedLight(), maps, **capture(camera=camera(flash=flash))), room)


def test_flash_without_an_offset_sits_at_the_lens():
    maps = random_maps(5)
    assert torch.equal(
        shade(FlashLight(), maps, **capture(flash_offset_cam_m=None)),
        shade(FlashLight(), maps, **capture(flash_offset_cam_m=(0, 0, 0))),
    )


def test_maps_that_know_a_gain_of_the_flash_have_it_in_the_flash_and_nowhere_else():
    maps = random_maps(4, 6)
    gain = 0.5 + torch.rand(4, 6, 3, generator=torch.Generator().manual_seed(5), dtype=DOUBLE)
    gained = with_fields(maps, flash_gain=gain)
    for settings in ({}, {"reflectance": Reflectance(0.5, 0.3, 0.04)}, {"lamp": Lamp(falloff=2.0)}):
        flash, room = (shade(light, maps, **capture(**settings)) for light in (FlashLight(), RoomLight()))
        torch.testing.assert_close(shade(FlashLight(), gained, **capture(**settings)), gain * flash)
        torch.testing.assert_close(shade(CapturedLight(), gained, **capture(**settings)), room + gain * flash)
    others = (DirectionalLight((0, 0, 1)), PointLight((0.3, 0.4, 0.5)), EnvironmentLight(panorama()))
    for light in (RoomLight(), *others):
        assert torch.equal(shade(light, gained, **capture()), shade(light, maps, **capture())), light


def test_a_gain_of_one_or_none_changes_nothing_and_off_the_mask_it_is_not_looked_at():
    maps = random_maps(4, 6)
    plain = shade(CapturedLight(), maps, **capture())
    ones = torch.ones(4, 6, 3, dtype=DOUBLE)
    broken = torch.where((maps.mask > 0)[..., None], ones, torch.nan)
    for gain in (None, ones, broken):
        assert torch.equal(shade(CapturedLight(), with_fields(maps, flash_gain=gain), **capture()), plain)


def test_maps_that_know_what_bounces_have_it_in_the_flash_and_nowhere_else():
    maps = random_maps(4, 6)
    bounce = torch.rand(4, 6, generator=torch.Generator().manual_seed(6), dtype=DOUBLE)
    bouncing = with_fields(maps, flash_bounce=bounce)
    factor = 1.0 + bounce[..., None] * maps.albedo
    for settings in ({}, {"lamp": Lamp(falloff=2.0)}):
        flash = shade(FlashLight(), maps, **capture(**settings))
        torch.testing.assert_close(shade(FlashLight(), bouncing, **capture(**settings)), factor * flash)
    # Gloss stays as it is: what bounces is added to the albedo.
    glossy, matte = Reflectance(0.0, 0.3, 0.04), Reflectance()
    gloss = [
        shade(FlashLight(), both, **capture(reflectance=glossy))
        - shade(FlashLight(), both, **capture(reflectance=matte))
        for both in (maps, bouncing)
    ]
    torch.testing.assert_close(*gloss)
    for light in (RoomLight(), DirectionalLight((0, 0, 1)), PointLight((0.3, 0.4, 0.5))):
        assert torch.equal(shade(light, bouncing, **capture()), shade(light, maps, **capture())), light


def test_a_flash_that_the_maps_know_themselves_takes_no_gain():
    maps, own = random_maps(4, 6), torch.full((4, 6, 3), 0.25, dtype=DOUBLE)
    known = with_fields(maps, flash_gain=2.0 * torch.ones(4, 6, 3, dtype=DOUBLE), flash_radiance=own)
    expected = own * (maps.mask > 0)[..., None]
    assert torch.equal(shade(FlashLight(), known, **capture()), expected)


def test_the_gain_of_the_flash_has_a_gradient():
    maps = random_maps(6)
    gain = torch.full((6, 3), 1.2, dtype=DOUBLE, requires_grad=True)

    def flash(gain):
        return shade(FlashLight(), with_fields(maps, flash_gain=gain), **capture())

    torch.autograd.gradcheck(flash, (gain,))


def test_directional_light_is_the_papers_formula_whatever_the_length_of_its_direction():
    maps = random_maps(4, 6)
    color = np.array([1.0, 0.8, 0.6])
    to_light = np.array([0.6, 0.0, 0.8])
    expected = plain(
        maps, lambda albedo, normal, *_: albedo * color * (0.3 + 0.7 * max(0.0, normal @ to_light))
    )
    light = DirectionalLight(to_light=(6.0, 0.0, 8.0), ambient=0.3, color=(1.0, 0.8, 0.6))
    np.testing.assert_allclose(shade(light, maps), expected, atol=1e-12)


def test_point_light_is_the_papers_formula():
    maps = random_maps(4, 6)
    position, strength = (0.3, 0.4, 0.5), np.array([0.9, 0.7, 0.6])
    expected = plain(
        maps, lambda albedo, normal, shading, point: albedo * strength * lambert(normal, point, position)
    )
    np.testing.assert_allclose(shade(PointLight(position, (0.9, 0.7, 0.6)), maps), expected, atol=1e-12)


def test_environment_is_albedo_over_pi_times_irradiance():
    maps, image = random_maps(4, 6), panorama()
    irradiance = DiffuseIrradiance.of_panorama(image)(maps.normals_world)
    expected = maps.albedo / math.pi * irradiance * (maps.mask > 0)[..., None]
    torch.testing.assert_close(shade(EnvironmentLight(image), maps), expected)
    torch.testing.assert_close(shade(EnvironmentLight(image, gain=2.5), maps), 2.5 * expected)


def test_rotated_environment_turns_its_light_about_up():
    maps, image = random_maps(30), panorama()
    turned_surface = replace(maps, normals_world=maps.normals_world @ rotation_about_up(-50.0).T)
    for method in ("exact", "sh"):
        rotated = shade(EnvironmentLight(image, rotate_deg=50.0, method=method), maps)
        # Turning the surface back is the same thing; both are rotated in double precision.
        torch.testing.assert_close(rotated, shade(EnvironmentLight(image, method=method), turned_surface))


def test_environment_by_spherical_harmonics_is_the_light_of_its_coefficients():
    maps, image = random_maps(30), panorama()
    coefficients = panorama_to_sh(image)
    expected = maps.albedo / math.pi * sh_irradiance(coefficients, maps.normals_world).clamp(min=0)
    expected = expected * (maps.mask > 0)[:, None]
    torch.testing.assert_close(shade(EnvironmentLight(image, method="sh"), maps), expected)
    torch.testing.assert_close(shade(SphericalHarmonicsLight(coefficients), maps), expected)


@pytest.mark.parametrize("bands", [1, 2, 4])
def test_other_numbers_of_coefficients_are_taken(bands):
    maps = random_maps(30)
    coefficients = torch.rand(bands * bands, 3, generator=torch.Generator().manual_seed(0), dtype=DOUBLE)
    irradiance = sh_irradiance(coefficients, maps.normals_world).clamp(min=0)
    expected = maps.albedo / math.pi * irradiance * (maps.mask > 0)[:, None]
    torch.testing.assert_close(shade(SphericalHarmonicsLight(coefficients), maps), expected)


def test_white_surface_in_a_world_of_radiance_one_has_radiance_one():
    coefficients = torch.zeros(9, 3, dtype=DOUBLE)
    coefficients[0] = 2 * math.sqrt(math.pi)
    maps = one_point((0.0, 0.6, 0.8))
    ones = torch.ones(1, 3, dtype=DOUBLE)
    torch.testing.assert_close(shade(SphericalHarmonicsLight(coefficients), maps), ones)
    # The tolerance of the irradiance table for uniform light.
    torch.testing.assert_close(shade(EnvironmentLight(np.ones((8, 16, 3))), maps), ones, rtol=5e-4, atol=0)


def test_visibility_dims_the_direct_part_only():
    maps = random_maps(4, 6)
    bright = {
        "directional": DirectionalLight((0, 0, 1), ambient=0.25, shadows=True),
        "point": PointLight((0.3, 0.4, 0.5)),
        "environment": EnvironmentLight(panorama()),
    }
    ambient = {"directional": 0.25 * maps.albedo * (maps.mask > 0)[..., None]}
    for name, light in bright.items():
        unshadowed = shade(light, maps)
        rest = ambient.get(name, torch.zeros_like(unshadowed))
        shadowed = shade(light, maps, visibility=HalfVisible((4, 6)))
        torch.testing.assert_close(shadowed, rest + 0.5 * (unshadowed - rest))


def test_lights_without_shadows_never_ask_for_visibility():
    maps, visibility = random_maps(4, 6), HalfVisible((4, 6))
    for light in (
        DirectionalLight((0, 0, 1)),
        PointLight((0, 0, 1), shadows=False),
        EnvironmentLight(panorama(), shadows=False),
        EnvironmentLight(panorama(), method="sh"),
        CapturedLight(),
    ):
        shade(light, maps, visibility=visibility, **capture())
    assert visibility.asked == []


def test_environment_without_visibility_of_directions_has_no_shadows():
    maps, light = random_maps(4, 6), EnvironmentLight(panorama())
    assert torch.equal(
        shade(light, maps, visibility=HalfVisible((4, 6), has_environment=False)), shade(light, maps)
    )


def test_full_visibility_changes_nothing():
    maps, light = random_maps(4, 6), EnvironmentLight(panorama(), rotate_deg=33.0, shadow_lights=8)
    visibility = HalfVisible((4, 6))
    visibility.half.fill_(1.0)
    # The ratio of a sum to itself.
    torch.testing.assert_close(
        shade(light, maps, visibility=visibility), shade(light, maps), rtol=1e-12, atol=0
    )


def test_environment_shadows_are_asked_in_the_rotated_world():
    image = np.zeros((16, 32, 3), np.float32)
    image[7:9, 15:17] = 1.0  # around +Z, which a turn of 90 degrees takes to +X
    visibility = HalfVisible((1,))
    shade(EnvironmentLight(image, rotate_deg=90.0), one_point((1.0, 0.0, 0.0)), visibility=visibility)
    directions = visibility.asked[0]
    # The patch is 22.5 degrees wide, its corners 16 degrees from the middle.
    assert (directions[:, 0] > math.cos(math.radians(16))).all()


def test_shadow_of_one_side_leaves_the_light_of_the_other():
    image = np.zeros((16, 32, 3), np.float32)
    image[7:9, 23:25] = (1.0, 0.0, 0.0)  # red from -X
    image[7:9, 7:9] = (0.0, 1.0, 0.0)  # green from +X

    class LeftHidden(HalfVisible):
        def environment(self, directions, irradiances):
            left = irradiances * (directions[:, :1] < 0)
            return (left.sum(dim=0) / irradiances.sum(dim=0).clamp(min=1e-12))[None]

    maps, light = one_point((0.0, 0.0, 1.0)), EnvironmentLight(image)
    open_, hidden = shade(light, maps), shade(light, maps, visibility=LeftHidden((1,)))
    torch.testing.assert_close(hidden[0, 0], open_[0, 0])
    assert hidden[0, 1] == 0.0 < open_[0, 1]


def test_zero_normals_keep_the_room_and_the_ambient_share_only():
    maps = one_point((0.0, 0.0, 0.0), albedo=0.5)
    dark = torch.zeros(1, 3, dtype=DOUBLE)
    lights: list[Light] = [
        FlashLight(),
        PointLight((0, 0, 1)),
        DirectionalLight((0, 0, 1)),
        EnvironmentLight(panorama()),
        EnvironmentLight(panorama(), method="sh"),
        SphericalHarmonicsLight(torch.ones(9, 3)),
    ]
    for light in lights:
        assert torch.equal(shade(light, maps, **capture()), dark), light
    assert torch.equal(shade(DirectionalLight((0, 0, 1), ambient=0.5), maps), dark + 0.25)
    assert torch.equal(shade(RoomLight(), maps, c_room=(1, 1, 1)), dark + 0.5)


def test_light_behind_the_surface_gives_nothing():
    maps = one_point((0.0, 0.0, -1.0))
    assert shade(PointLight((0, 0, 1)), maps).sum() == 0
    assert shade(DirectionalLight((0, 0, 1)), maps).sum() == 0


def test_point_light_at_the_surface_is_finite_with_its_gradients():
    for height in (0.0, 1e-12, 0.5 * MIN_DISTANCE_M, MIN_DISTANCE_M):
        point = torch.tensor([[0.0, 0.0, -height]], dtype=DOUBLE, requires_grad=True)
        normals = torch.tensor([[0.0, 0.0, 1.0]], dtype=DOUBLE, requires_grad=True)
        maps = replace(one_point((0, 0, 1)), points_world=point, normals_world=normals)
        radiance = shade(PointLight((0, 0, 0)), maps)
        assert (radiance <= 1.0 / MIN_DISTANCE_M**2 * (1 + 1e-12)).all()
        radiance.sum().backward()
        assert point.grad is not None
        assert normals.grad is not None
        assert torch.isfinite(point.grad).all()
        assert torch.isfinite(normals.grad).all()


@pytest.mark.parametrize("decade", range(-6, 7, 3))
def test_radiance_and_gradients_are_finite_over_many_decades_in_single_precision(decade):
    scale = 10.0**decade
    point = (torch.tensor([[0.3, 0.2, -0.9]]) * scale).requires_grad_()
    maps = replace(one_point((0, 0, 1), dtype=torch.float32), points_world=point)
    radiance = shade(PointLight((0, 0, 0), (scale**2, scale**2, scale**2)), maps)
    radiance.sum().backward()
    assert torch.isfinite(radiance).all()
    assert point.grad is not None
    assert torch.isfinite(point.grad).all()


def test_black_albedo_and_an_empty_mask_give_black():
    lights = [CapturedLight(), DirectionalLight((0, 0, 1), ambient=0.5), EnvironmentLight(panorama())]
    maps = random_maps(4, 6)
    for light in lights:
        assert shade(light, replace(maps, albedo=0 * maps.albedo), **capture()).abs().sum() == 0
        assert shade(light, replace(maps, mask=0 * maps.mask), **capture()).abs().sum() == 0


def test_nan_stays_in_its_own_pixel():
    maps = random_maps(6)
    broken = replace(maps, normals_world=maps.normals_world.clone(), albedo=maps.albedo.clone())
    broken.normals_world[1] = math.nan
    broken.albedo[3] = math.nan
    broken.albedo[4] = math.nan  # outside the mask
    for light in (CapturedLight(), PointLight((0, 0, 1)), EnvironmentLight(panorama())):
        radiance, clean = shade(light, broken, **capture()), shade(light, maps, **capture())
        assert torch.isnan(radiance[[1, 3]]).all()
        assert torch.equal(radiance[[0, 2, 4, 5]], clean[[0, 2, 4, 5]])


@pytest.mark.parametrize(
    "light",
    [
        CapturedLight(),
        DirectionalLight((0.3, -0.5, 0.8), ambient=0.2),
        PointLight((0.3, 0.4, 0.5)),
        EnvironmentLight(panorama()),
        EnvironmentLight(panorama(), method="sh"),
        SphericalHarmonicsLight(panorama_to_sh(panorama(), 3)),
        RoomLight() + PointLight((0.3, 0.4, 0.5)),
    ],
    ids=lambda light: type(light).__name__,
)
def test_gradients_match_finite_differences(light):
    maps = random_maps(8)

    def radiance(albedo, normals, shading, points, c_room, c_flash):
        surface = replace(
            maps, albedo=albedo, normals_world=normals, shading=shading, points_world=points, mask=maps.mask
        )
        return shade(light, surface, **capture(c_room=c_room, c_flash=c_flash))

    inputs = (
        maps.albedo,
        maps.normals_world,
        maps.shading,
        maps.points_world,
        torch.tensor(C_ROOM, dtype=DOUBLE),
        torch.tensor(C_FLASH, dtype=DOUBLE),
    )
    assert torch.autograd.gradcheck(radiance, tuple(value.clone().requires_grad_() for value in inputs))


def test_coefficients_are_differentiable_too():
    maps, coefficients = random_maps(8), panorama_to_sh(panorama()).requires_grad_()
    assert torch.autograd.gradcheck(lambda c: shade(SphericalHarmonicsLight(c), maps), coefficients)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_precision_of_the_maps_is_kept(dtype):
    maps = random_maps(4, 6, dtype=dtype)
    single = random_maps(4, 6, dtype=DOUBLE)
    for light in (CapturedLight(), DirectionalLight((0, 0, 1)), EnvironmentLight(panorama())):
        radiance = shade(light, maps, visibility=HalfVisible((4, 6)), **capture())
        assert radiance.dtype == dtype
        # A few roundings of single precision; E adds 4096 tiles.
        expected = shade(light, single, visibility=HalfVisible((4, 6)), **capture())
        torch.testing.assert_close(radiance.double(), expected, rtol=1e-4, atol=1e-6)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_gives_the_same_radiance():
    maps = random_maps(4, 6, dtype=torch.float32)
    on_gpu = FlatMaps(**{name: value.cuda() for name, value in vars(maps).items()})
    for light in (
        CapturedLight(),
        PointLight((0, 0, 1)),
        EnvironmentLight(panorama()),
        SphericalHarmonicsLight(torch.ones(9, 3)),
    ):
        # Single precision, another order of sums.
        torch.testing.assert_close(
            shade(light, on_gpu, **capture()).cpu(), shade(light, maps, **capture()), rtol=1e-4, atol=1e-6
        )


def test_missing_colours_and_wrong_values_are_refused():
    maps = random_maps(4)
    with pytest.raises(ValueError, match="needs c_room"):
        shade(RoomLight(), maps)
    with pytest.raises(ValueError, match="needs c_flash"):
        shade(FlashLight(), maps, camera=camera())
    with pytest.raises(ValueError, match="to_light"):
        DirectionalLight((0, 0, 0))
    with pytest.raises(ValueError, match=r"ambient is 1\.5"):
        DirectionalLight((0, 0, 1), ambient=1.5)
    with pytest.raises(ValueError, match="exact or sh"):
        EnvironmentLight(panorama(), method="fast")
    with pytest.raises(ValueError, match=r"\[H, W, 3\]"):
        EnvironmentLight(np.ones((4, 8)))
    with pytest.raises(ValueError, match="5 coefficients"):
        SphericalHarmonicsLight(torch.zeros(5, 3))


def test_an_environment_shows_the_reflectance_s_gloss():
    image = panorama()
    reflectance = Reflectance(retro=0.5, alpha=0.25, f0=0.04)
    maps = one_point((0.0, 0.0, 1.0), albedo=0.0)
    camera = looking_at(np.array([0.0, 0.0, 1.0]), np.zeros(3))
    light = EnvironmentLight(image, gain=2.0)
    glossy = shade(light, maps, camera=camera, reflectance=reflectance)
    to_light = torch.from_numpy(lat_long_directions(*image.shape[:2])).view(-1, 3)
    weight = np.repeat(lat_long_solid_angles(*image.shape[:2]), image.shape[1])[:, None]
    normal = torch.tensor([[0.0, 0.0, 1.0]], dtype=DOUBLE)
    response = reflectance.response(torch.zeros(1, 3, dtype=DOUBLE), normal, to_light, normal)
    expected = 2.0 / math.pi * (response.numpy() * weight * image.reshape(-1, 3)).sum(axis=0)
    # The lobe's masking and Fresnel are left out where the panorama is blurred by it: some hundredths.
    np.testing.assert_allclose(glossy[0], expected, rtol=0.06)
    # Without a camera there is no view to mirror.
    np.testing.assert_array_equal(shade(light, maps, reflectance=reflectance), 0.0)


def test_light_from_other_parts_is_added():
    class Bounced(HalfVisible):
        def indirect(self, light, arriving):
            return torch.full((1, 3), 0.25, dtype=DOUBLE)

    maps = one_point((0.0, 0.0, 1.0), albedo=0.5)
    lamp = PointLight((0.0, 0.0, 1.0), C=(2.0, 2.0, 2.0))
    radiance = shade(lamp, maps, visibility=Bounced((1,)))
    np.testing.assert_allclose(radiance, 0.5 * (2.0 * 0.5 + 0.25), rtol=1e-6)
    sun = DirectionalLight((0.0, 0.0, 1.0), ambient=0.2, shadows=True)
    radiance = shade(sun, maps, visibility=Bounced((1,)))
    np.testing.assert_allclose(radiance, 0.5 * (0.2 + 0.8 * (0.5 + 0.25)), rtol=1e-6)
    # The paper's directional light has no shadows, and no bounce.
    radiance = shade(replace(sun, shadows=False), maps, visibility=Bounced((1,)))
    np.testing.assert_allclose(radiance, 0.5 * (0.2 + 0.8), rtol=1e-6)


def test_lights_of_no_possible_size_are_refused():
    for radius in (-0.1, math.inf, math.nan):
        with pytest.raises(ValueError, match="radius"):
            PointLight((0, 0, 1), radius=radius)
    for angle in (-1.0, 150.0, math.nan):
        with pytest.raises(ValueError, match="angle"):
            DirectionalLight((0, 0, 1), angle_deg=angle)
