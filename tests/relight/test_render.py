"""Files of a rendering: their names, what is in them, how they are exposed, and the orbit."""

import av
import numpy as np
import OpenEXR
import pytest
import torch
from analytic_scene import arc, looking_at, portrait_of, sphere_portrait

from capture.images import read_image
from relight.confidence import NAMES
from relight.lighting import (
    CapturedLight,
    DirectionalLight,
    FlashLight,
    PointLight,
    RoomLight,
    SumLight,
)
from relight.render import (
    EXPOSED_TO,
    PortraitRenderer,
    display_picture,
    orbit_cameras,
    render_files,
    render_orbit,
    render_view,
)

RADIUS_M = 0.1
ALBEDO = (0.6, 0.4, 0.3)
C_FLASH = (0.11, 0.10, 0.09)
OFFSET = (0.015, -0.01, 0.0)
EYE = np.array([0.1, 0.15, 0.45])
TO_LIGHT = (0.48, 0.6, 0.64)


@pytest.fixture(scope="module")
def portrait():
    room = 0.2 * np.array(ALBEDO)
    return sphere_portrait(
        20_000, RADIUS_M, albedo=ALBEDO, room_radiance=room, c_flash=C_FLASH, flash_offset_cam_m=OFFSET
    )


@pytest.fixture(scope="module")
def cameras():
    return [
        looking_at(EYE, np.zeros(3), "0010", size=48, flash=1),
        looking_at(EYE * [-1, 1, 1], np.zeros(3), "left.view", size=48, flash=0),
    ]


LIGHTS = {
    "captured": CapturedLight(),
    "room": RoomLight(),
    "dir1": DirectionalLight(TO_LIGHT, ambient=0.25),
    "lamp": PointLight((0.2, 0.1, 0.4), (0.05, 0.05, 0.06)),
}


@pytest.fixture(scope="module")
def rendered(portrait, cameras, tmp_path_factory):
    out = tmp_path_factory.mktemp("rendered") / "deep" / "folder"
    told = []
    files = render_files(portrait, cameras, LIGHTS, out, maps=True, progress=lambda *step: told.append(step))
    return out, files, told


def channels(path):
    """An EXR by the OpenEXR package alone: (names of the channels, type, [H, W] or [H, W, 3] float64)."""
    with OpenEXR.File(str(path)) as file:
        found = file.channels()
        layers = {name: np.asarray(layer.pixels) for name, layer in found.items()}
    names = "".join(sorted(layers))
    array = next(iter(layers.values()))
    return names, array.dtype, array.astype(np.float64)


def truth(camera):
    """Whether each pixel shows the sphere [H, W], well inside of it, and where [H, W, 3]."""
    v, u = np.mgrid[0 : camera.height, 0 : camera.width] + 0.5
    rays = (
        np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T @ camera.cam_from_world[:3, :3]
    )
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    eye = camera.centre_world
    b, c = (rays * eye).sum(axis=-1), eye @ eye - RADIUS_M**2
    where = eye + (-b - np.sqrt(np.maximum(b * b - c, 0)))[..., None] * rays
    facing = -(where / RADIUS_M * rays).sum(axis=-1)
    return b * b > c, (b * b > c) & (facing > 0.4), where


def test_files_have_the_names_that_other_tools_read(rendered):
    out, files, _ = rendered
    maps = ["albedo", "normal", "shading", "mask", "depth", *NAMES]
    expected = {f"{name}.{layer}.exr" for name in ("0010", "left.view") for layer in [*maps, *LIGHTS]}
    expected |= {f"{name}.{light}.png" for name in ("0010", "left.view") for light in LIGHTS}
    assert {path.name for path in out.iterdir()} == expected
    assert sorted(path.name for path in files) == sorted(expected)
    assert all(path.parent == out for path in files)


def test_progress_counts_the_views(rendered):
    assert rendered[2] == [("render", 0.5), ("render", 1.0)]


def test_without_maps_there_are_only_pictures(portrait, cameras, tmp_path):
    render_files(portrait, cameras[:1], {"room": RoomLight()}, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"0010.room.exr", "0010.room.png"}


# Splats and unevenness of 20,000 points err by about 0.2 degrees; half floats hold a part in 2048.
def test_maps_are_those_of_the_sphere(rendered, cameras):
    out = rendered[0]
    for camera in cameras:
        hit, inner, where = truth(camera)
        names, dtype, normal = channels(out / f"{camera.name}.normal.exr")
        assert (names, dtype) == ("RGB", np.float16)
        # World axes, unit: R, G, B = X, Y, Z.
        np.testing.assert_allclose(normal[inner], where[inner] / RADIUS_M, atol=0.02)
        _, _, albedo = channels(out / f"{camera.name}.albedo.exr")
        np.testing.assert_allclose(albedo[inner], np.tile(ALBEDO, (inner.sum(), 1)), rtol=1e-3)
        names, _, mask = channels(out / f"{camera.name}.mask.exr")
        assert mask.shape == hit.shape
        assert mask.max() <= 1
        assert mask.min() == 0
        assert ((mask > 0.5) & hit).sum() / ((mask > 0.5) | hit).sum() > 0.97
        _, _, shading = channels(out / f"{camera.name}.shading.exr")
        np.testing.assert_allclose(shading[inner], 1.0, rtol=1e-3)
        assert shading.shape == hit.shape
        _, dtype, depth = channels(out / f"{camera.name}.depth.exr")
        assert dtype == np.float32
        z = where @ camera.cam_from_world[2, :3] + camera.cam_from_world[2, 3]
        np.testing.assert_allclose(depth[inner], z[inner], atol=0.001)  # metres; points are 2.5 mm apart
        assert not depth[mask == 0].any()


def test_linear_pictures_are_the_light_on_the_surface(rendered, cameras):
    out = rendered[0]
    for camera in cameras:
        _, inner, where = truth(camera)
        normals = where[inner] / RADIUS_M
        room = np.tile(0.2 * np.array(ALBEDO), (inner.sum(), 1))
        flash = camera.centre_world + camera.cam_from_world[:3, :3].T @ OFFSET
        towards = flash - where[inner]
        square = (towards**2).sum(axis=1, keepdims=True)
        lit = (
            np.array(ALBEDO) * C_FLASH / square * (normals * towards / np.sqrt(square)).sum(1, keepdims=True)
        )
        expected = {
            "room": room,
            "captured": room + camera.flash * lit,
            "dir1": np.array(ALBEDO) * (0.25 + 0.75 * (normals @ TO_LIGHT).clip(0)[:, None]),
        }
        for name, radiance in expected.items():
            names, dtype, picture = channels(out / f"{camera.name}.{name}.exr")
            assert (names, dtype) == ("RGB", np.float16)
            # Normals to 0.02, on light of up to 0.6.
            np.testing.assert_allclose(picture[inner], radiance, atol=0.02 * 0.6 + 1e-3)


def test_display_pictures_are_srgb_on_black(rendered, cameras):
    out = rendered[0]
    _, _, linear = channels(out / "0010.captured.exr")
    _, _, mask = channels(out / "0010.mask.exr")
    linear = linear.clip(0, 1)
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    picture = read_image(out / "0010.captured.png")
    assert picture.dtype == np.uint8
    # Half a code of rounding, and another of the half floats.
    np.testing.assert_allclose(picture, 255 * srgb * mask[..., None], atol=1.01)
    assert not picture[0, 0].any()


def test_new_lights_are_exposed_once_for_all_views(rendered, cameras):
    out = rendered[0]
    ratios = []
    for camera in cameras:
        _, _, linear = channels(out / f"{camera.name}.dir1.exr")
        _, _, mask = channels(out / f"{camera.name}.mask.exr")
        srgb = read_image(out / f"{camera.name}.dir1.png") / 255
        shown = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        usable = (mask == 1) & (shown.max(axis=-1) < 0.95) & (shown.max(axis=-1) > 0.2)
        ratios.append(np.median(shown[usable] / linear[usable]))
        if camera is cameras[0]:
            top = np.percentile(linear.max(axis=-1)[mask > 0.5], 99.5)
    assert ratios[0] == pytest.approx(EXPOSED_TO / top, rel=0.01)  # codes of 8 bits
    assert ratios[1] == pytest.approx(ratios[0], rel=0.01)


def test_captured_lights_are_shown_as_captured(rendered):
    out = rendered[0]
    _, _, linear = channels(out / "0010.room.exr")
    srgb = read_image(out / "0010.room.png")[24, 24] / 255
    shown = ((srgb + 0.055) / 1.055) ** 2.4
    np.testing.assert_allclose(shown, linear[24, 24], atol=0.005)  # a code of 8 bits


@pytest.fixture(scope="module")
def ball_over_floor():
    side = np.arange(-0.15, 0.15, 0.002)
    x, y = (axis.ravel() for axis in np.meshgrid(side, side))
    floor = np.stack([x, y, np.zeros_like(x)], axis=1)
    ball = sphere_portrait(5000, 0.04)
    points = np.concatenate([floor, ball.points.numpy() + np.array([0, 0, 0.08])])
    normals = np.concatenate([np.tile([0.0, 0, 1], (len(floor), 1)), ball.normals_world.numpy()])
    return portrait_of(points, normals, 0.002)


# The ball's shadow on the floor is an ellipse of 0.04 by 0.05 m, at 200 px a metre; a lamp at 0.24 m enlarges
# that of a ball at 0.08 m by 1.5. The ball itself hides some of it.
@pytest.mark.parametrize(
    ("light", "area_px"),
    [
        (DirectionalLight((0.6, 0.0, 0.8), shadows=True), 251),
        (PointLight((0.18, 0.0, 0.24), (0.05,) * 3), 565),
    ],
)
def test_shadows_fall_and_can_be_turned_off(ball_over_floor, light, area_px):
    camera = looking_at(np.array([-0.05, 0.1, 0.5]), np.zeros(3), size=64, focal_px=100)
    _, shadowed = render_view(ball_over_floor, camera, {"light": light})
    _, plain = render_view(ball_over_floor, camera, {"light": light}, shadows=False)
    shaded = (shadowed["light"] < 0.5 * plain["light"]).all(dim=-1)
    assert 0.4 * area_px < shaded.sum() < 1.2 * area_px
    lit = (plain["light"] > 0).all(dim=-1) & ~shaded
    # What the capture's flash bounced is taken out of the albedo near the ball; the rest is penumbra.
    assert (shadowed["light"][lit] > 0.95 * plain["light"][lit]).float().mean() > 0.9


def test_captured_lights_cast_no_shadows(ball_over_floor):
    camera = looking_at(np.array([0.0, 0.1, 0.5]), np.zeros(3), size=32, focal_px=50, flash=1)
    for light in (CapturedLight(), RoomLight(), FlashLight(), SumLight((RoomLight(), FlashLight()))):
        _, shadowed = render_view(ball_over_floor, camera, {"light": light})
        _, plain = render_view(ball_over_floor, camera, {"light": light}, shadows=False)
        np.testing.assert_array_equal(shadowed["light"], plain["light"])


def test_the_flag_of_a_view_can_be_overruled(portrait, cameras):
    lit, dark = (render_view(portrait, camera, {"c": CapturedLight()})[1]["c"] for camera in cameras)
    renderer = PortraitRenderer(portrait)
    np.testing.assert_array_equal(renderer.view(cameras[1], {"c": CapturedLight()}, 0)[1]["c"], dark)
    np.testing.assert_array_equal(renderer.view(cameras[0], {"c": CapturedLight()}, 1)[1]["c"], lit)
    assert renderer.view(cameras[0], {"c": CapturedLight()}, 0)[1]["c"].max() < lit.max()


def test_a_view_that_sees_nothing_is_black(portrait, tmp_path):
    away = looking_at(EYE, 2 * EYE, "away", size=16, flash=1)
    render_files(portrait, [away], LIGHTS, tmp_path, maps=True)
    for path in tmp_path.glob("*.exr"):
        assert not channels(path)[2].any(), path.name
    for path in tmp_path.glob("*.png"):
        assert not read_image(path).any(), path.name


def test_display_pictures_clip():
    radiance = torch.tensor([[[2.0, 0.5, -1.0]]])
    np.testing.assert_array_equal(display_picture(radiance, torch.ones(1, 1))[0, 0], [255, 188, 0])
    np.testing.assert_array_equal(display_picture(radiance, torch.full((1, 1), 0.5))[0, 0], [128, 94, 0])
    np.testing.assert_array_equal(display_picture(radiance, torch.ones(1, 1), 0.25)[0, 0], [188, 99, 0])


def decoded(path):
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        frames = [
            (float(frame.pts * stream.time_base), frame.to_ndarray(format="rgb24"))
            for frame in container.decode(stream)
        ]
    return [time_s for time_s, _ in frames], np.stack([picture for _, picture in frames])


@pytest.mark.parametrize("rotation_deg", [0, 90])
def test_an_orbit_is_a_video_that_goes_there_and_back(portrait, tmp_path, rotation_deg):
    cameras = [
        camera.scaled(65 / 64) for camera in arc(12, size=64)
    ]  # 65 pixels: an odd side, which H.264 has not
    file = tmp_path / "orbit.mp4"
    told = []
    render_orbit(
        portrait,
        cameras,
        RoomLight(),
        file,
        seconds=0.4,
        rotation_deg=rotation_deg,
        progress=lambda *step: told.append(step),
    )
    times_s, pictures = decoded(file)
    assert pictures.shape == (12, 64, 64, 3)
    np.testing.assert_allclose(times_s, np.arange(12) / 30, atol=1e-4)  # ticks of the container
    assert told[-1] == ("orbit", 1.0)
    # A sphere in an even light is the same from everywhere: 0.2 of its albedo, coded by H.264 to a few codes.
    linear = 0.2 * np.array(ALBEDO)
    expected = 255 * (1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(pictures[:, 32, 32], np.tile(expected, (12, 1)), atol=6)
    assert pictures[:, 0, 0].max() < 12


def test_orbit_cameras_swing_over_the_captured_arc_and_look_at_the_middle():
    captured = arc(37)
    path = orbit_cameras(captured, np.zeros(3), 60)
    assert [camera.name for camera in path[:2]] == ["0000", "0001"]
    positions = np.stack([camera.centre_world for camera in path])
    azimuths = np.degrees(np.arctan2(positions[:, 0], positions[:, 2]))
    # The 5th to 95th percentile of -80 to 80 degrees; the cameras' sway turns their mean up axis by a degree.
    assert azimuths.min() == pytest.approx(-72, abs=2)
    assert azimuths.max() == pytest.approx(72, abs=2)
    assert abs(np.diff(azimuths)).max() < 9
    np.testing.assert_allclose(positions[1:30], positions[:30:-1], atol=1e-12)  # there and back
    np.testing.assert_allclose(np.linalg.norm(positions, axis=1), 0.5, atol=0.02)
    for camera in path:
        rotation = camera.cam_from_world[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        middle = camera.cam_from_world[:3, 3]  # where the origin is
        np.testing.assert_allclose(middle[:2], 0.0, atol=1e-12)
        assert middle[2] > 0
        assert rotation[1, 1] < -0.9  # the head is upright: the picture's y points down


def test_an_orbit_of_one_camera_or_a_full_circle_is_finite():
    circle = [
        looking_at(0.5 * np.array([np.sin(a), 0.0, np.cos(a)]), np.zeros(3)) for a in np.arange(8) * np.pi / 4
    ]
    for captured in (circle, circle[:1]):
        assert all(
            np.isfinite(camera.cam_from_world).all() for camera in orbit_cameras(captured, np.zeros(3), 5)
        )


def test_an_orbit_without_cameras_is_refused(portrait, tmp_path):
    with pytest.raises(ValueError, match="needs the captured cameras"):
        render_orbit(portrait, [], RoomLight(), tmp_path / "orbit.mp4")
