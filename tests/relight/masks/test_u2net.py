"""The optional network: its names, its files, its tuning. No real weights are needed."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from relight.errors import GeometryError
from relight.masks import MaskConfig, find_masks
from relight.masks.frames import FrameSource
from relight.masks.subject import find_subject
from relight.masks.tune import network_mask, tune
from relight.masks.u2net import U2Net, load_u2net, network_input


def random_network(seed=0):
    torch.manual_seed(seed)
    return U2Net(small=True).eval()


def test_names_and_sizes_are_those_of_the_published_checkpoints():
    with torch.device("meta"):
        full, small = U2Net().state_dict(), U2Net(small=True).state_dict()
    assert len(full) == len(small) == 798
    # 176.3 and 4.7 MB, as the authors state of u2net.pth and u2netp.pth.
    weights = [
        sum(tensor.numel() for name, tensor in state.items() if "running" not in name and "num_" not in name)
        for state in (full, small)
    ]
    assert weights == [44_009_869, 1_131_181]
    assert full["stage1.rebnconvin.conv_s1.weight"].shape == (64, 3, 3, 3)
    assert full["stage1.rebnconv7.bn_s1.running_mean"].shape == (32,)
    assert full["stage5d.rebnconv1d.conv_s1.weight"].shape == (512, 512, 3, 3)
    assert full["stage1d.rebnconv2d.conv_s1.weight"].shape == (16, 32, 3, 3)
    assert full["side6.weight"].shape == (1, 512, 3, 3)
    assert full["outconv.weight"].shape == (1, 6, 1, 1)


@pytest.mark.parametrize("suffix", [".pth", ".safetensors"])
@pytest.mark.parametrize("prefix", ["", "module."])
def test_a_checkpoint_loads_and_gives_the_same_answer(tmp_path, suffix, prefix):
    network = random_network()
    state = {prefix + name: tensor.clone() for name, tensor in network.state_dict().items()}
    path = tmp_path / f"u2netp{suffix}"
    if suffix == ".pth":
        torch.save(state, path)
    else:
        save_file(state, path)
    picture = torch.rand(1, 3, 64, 64)
    with torch.no_grad():
        assert torch.equal(load_u2net(path)(picture), network(picture))


def test_any_size_of_picture_gives_a_mask_of_that_size():
    with torch.no_grad():
        assert random_network()(torch.rand(1, 3, 50, 70)).shape == (1, 1, 50, 70)


def test_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(GeometryError, match=r"no U2-Net checkpoint .*none\.pth"):
        load_u2net(tmp_path / "none.pth")


@pytest.mark.parametrize("name", ["torn.pth", "torn.safetensors"])
def test_a_torn_file_is_one_sentence(tmp_path, name):
    (tmp_path / name).write_bytes(b"PK\x03\x04 no checkpoint")
    with pytest.raises(GeometryError, match="tensors alone"):
        load_u2net(tmp_path / name)


class Trap:
    """An object that runs code when it is unpickled."""

    ran = False

    def __reduce__(self):
        return (setattr, (Trap, "ran", True))


def test_a_file_with_code_is_refused_and_not_run(tmp_path):
    torch.save({"stage1": Trap()}, tmp_path / "trap.pth")
    Trap.ran = False
    with pytest.raises(GeometryError, match="tensors alone"):
        load_u2net(tmp_path / "trap.pth")
    assert not Trap.ran


def test_another_network_is_told_by_its_tensors(tmp_path):
    state = random_network().state_dict()
    del state["side3.bias"]
    torch.save(state, tmp_path / "a.pth")
    with pytest.raises(GeometryError, match=r"side3\.bias is missing"):
        load_u2net(tmp_path / "a.pth")
    torch.save({"conv.weight": torch.zeros(3)}, tmp_path / "b.pth")
    with pytest.raises(GeometryError, match="does not fit"):
        load_u2net(tmp_path / "b.pth")
    torch.save([torch.zeros(3)], tmp_path / "c.pth")
    with pytest.raises(GeometryError, match="no state dict"):
        load_u2net(tmp_path / "c.pth")


def test_a_black_picture_is_finite():
    assert torch.isfinite(network_input(np.zeros((20, 30, 3), np.float32), 32)).all()


def test_tuning_brings_the_views_to_agree(film, scene):
    """Random weights, whose masks are noise about a half, come to hold what the cloud's hull holds."""
    source = FrameSource(film.session, {i: film.cameras[i] for i in (0, 8)}, 64)
    frames = list(source.frames.values())
    subject = find_subject(scene.cloud(), [frame.camera for frame in frames])
    network = random_network()
    with torch.no_grad():  # a network that claims everything: each view holds the cloud, none agrees with it
        network.outconv.bias.fill_(1.5)
    pictures = {frame.index: network_input(source.radiance(frame), 32) for frame in frames}
    found = tune(network, lambda frame: pictures[frame.index], frames, subject, 12, 1e-3, 0.2)
    assert found.steps == 12
    assert found.after < 0.7 * found.before
    assert not network.training
    for frame in frames:
        mask = network_mask(network, pictures[frame.index], frame)
        truth = film.truth[frame.index][::2, ::2] > 0.5
        assert mask[truth].mean() > mask[~truth].mean()


def test_a_network_that_sees_nothing_cannot_be_tuned(film, scene):
    source = FrameSource(film.session, {0: film.cameras[0]}, 48)
    frames = list(source.frames.values())
    subject = find_subject(scene.cloud(), [frames[0].camera])
    network = random_network()
    with torch.no_grad():
        network.outconv.bias.fill_(-20.0)
    picture = network_input(source.radiance(frames[0]), 32)
    with pytest.raises(GeometryError, match="tune_steps to 0"):
        tune(network, lambda _: picture, frames, subject, 2, 1e-3, 0.2)


def test_masks_take_a_network_and_a_bad_one_does_not_spoil_them(film, scene, tmp_path, monkeypatch):
    monkeypatch.setattr("relight.masks.u2net.INPUT_PX", 32)
    network = random_network()
    with torch.no_grad():  # about as much for as against, everywhere
        network.outconv.bias.fill_(0.5)
    torch.save(network.state_dict(), tmp_path / "u2netp.pth")
    few = {index: film.cameras[index] for index in (4, 5)}
    config = MaskConfig(working_px=96, rounds=1)
    config = replace(config, u2net=str(tmp_path / "u2netp.pth"), tune_steps=1)
    result = find_masks(film.session, few, scene.cloud(), None, tmp_path / "m", config)
    assert result.report["network"]
    assert result.report["network_tuning"]["steps"] == 1
    for index in few:
        found, truth = film.mask(tmp_path / "m", index) > 0.5, film.truth[index] > 0.5
        assert np.count_nonzero(found & truth) > 0.94 * np.count_nonzero(found | truth)
