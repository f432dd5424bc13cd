"""VGG-16 has the layers that torchvision names, and takes its weights from files that hold only tensors."""

import pickle

import pytest
import torch
from safetensors.torch import save_file

from relight.errors import RefineError
from relight.neural.vgg import LAYERS, Vgg16, load_vgg16

CONVOLUTIONS = (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
"""Places of the convolutions among torchvision's `features`."""


def weights(layers=LAYERS):
    torch.manual_seed(0)
    return {name: values.clone() for name, values in Vgg16(layers).state_dict().items()}


def test_its_convolutions_are_where_torchvision_has_them():
    network = Vgg16(["relu5_3"])
    named = [name for name in network.state_dict() if name.endswith("weight")]
    assert named == [f"features.{place}.weight" for place in CONVOLUTIONS]
    channels = [tuple(network.state_dict()[name].shape[:2]) for name in named]
    assert channels[:3] == [(64, 3), (64, 64), (128, 64)]
    assert channels[-1] == (512, 512)
    # Simonyan and Zisserman 2014, configuration D: 14.7 million parameters in its convolutions.
    assert sum(parameter.numel() for parameter in network.parameters()) == 14_714_688


def test_it_gives_the_layers_that_were_asked_for_shallowest_first():
    found = Vgg16(["relu3_3", "relu1_2"])(torch.rand(1, 3, 16, 16))
    assert [tuple(each.shape) for each in found] == [(1, 64, 16, 16), (1, 256, 4, 4)]
    assert all(float(each.detach().min()) >= 0 for each in found)
    with pytest.raises(ValueError, match="no layer 'relu6_1'"):
        Vgg16(["relu6_1"])


@pytest.mark.parametrize("suffix", [".safetensors", ".pth"])
def test_weights_come_from_a_file_and_do_not_learn(tmp_path, suffix):
    layers, path = ("relu1_2", "relu2_1"), tmp_path / f"vgg16{suffix}"
    # As torchvision's whole network, which has more than is needed here.
    state = weights(["relu2_2"]) | {"classifier.0.weight": torch.zeros(2, 2)}
    save_file(state, path) if suffix == ".safetensors" else torch.save(state, path)
    network = load_vgg16(path, layers)
    assert not any(parameter.requires_grad for parameter in network.parameters())
    for name, values in network.state_dict().items():
        assert torch.equal(values, state[name])


def test_files_that_are_none_are_refused_in_one_sentence(tmp_path):
    layers, path = ["relu1_2"], tmp_path / "vgg16.pth"

    def refused():
        with pytest.raises(RefineError) as caught:
            load_vgg16(path, layers)
        assert str(path) in str(caught.value)
        return str(caught.value)

    assert "There is no file" in refused()
    for scrap in (b"", b"PK\x03\x04", b"garbage" * 99):
        path.write_bytes(scrap)
        assert "cannot be read" in refused()
    torch.save([1, 2], path)
    assert "no table of weights" in refused()
    whole = weights(layers)
    for name in ("features.0.weight", "features.2.bias"):
        torch.save({key: values for key, values in whole.items() if key != name}, path)
        assert "does not hold the weights" in refused()
        torch.save(whole | {name: whole[name][..., None]}, path)
        assert "does not hold the weights" in refused()
    torch.save(whole | {"features.0.bias": torch.full((64,), torch.nan)}, path)
    assert "not finite" in refused()


class _Runs:
    def __reduce__(self):
        return print, ("this must never be printed",)


def test_a_file_that_would_run_code_is_refused(tmp_path, capsys):
    path = tmp_path / "vgg16.pth"
    path.write_bytes(pickle.dumps(_Runs(), protocol=2))
    with pytest.raises(RefineError, match="cannot be read"):
        load_vgg16(path)
    torch.save({"features.0.weight": _Runs()}, path)
    with pytest.raises(RefineError, match="cannot be read"):
        load_vgg16(path)
    assert "never" not in capsys.readouterr().out
