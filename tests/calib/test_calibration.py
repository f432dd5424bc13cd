import contextlib
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.calibration import Calibration, Intrinsics, Quantity, load_calibration, save_calibration
from capture.errors import CalibrationError
from capture.response import Response, load_response


def everything():
    return Calibration(
        intrinsics=Intrinsics(
            640,
            480,
            Quantity.of([500.1, 501.2, 320.3, 240.4], "px", "board.json, 40 views", [0.1, 0.1, 0.2, 0.2]),
            Quantity.of([0.1, -0.2, 0.003, 0.004, 0.05], "1", "board.json, 40 views"),
        ),
        response=Response(None, np.linspace(0, 1, 4), np.linspace(0, 1, 4) ** 2, "sweep of 12 exposures"),
        dark=Quantity.of([0.01, 0.011, 0.012], "1", "8 frames with the lens covered", 1e-4),
        noise_read=Quantity.of([1e-3] * 3, "1", "as dark"),
        noise_shot=Quantity.of([2e-4] * 3, "1", "sweep"),
        flat_field=Quantity.of([-0.3, 0.02], "1", "white wall"),
        colour=Quantity.of(np.eye(3) * 1.1, "1", "chart"),
        room_white=Quantity.of([1.2, 1.0, 0.8], "1", "chart"),
        flash_offset_cam_m=Quantity.of([0.013, -0.007, 0.0], "m", "ruler", [0.001] * 3),
        flash_axis=Quantity.of([0.0, 0.6, 0.8], "1", "wall"),
        flash_falloff=Quantity.of(1.5, "1", "wall"),
        flash_strength=Quantity.of([0.16, 0.157, 0.15], "m^2", "grey card"),
        readout_s=Quantity.of(-0.0201, "s", "30 flashes", 1e-4),
    )


def test_everything_that_is_saved_is_loaded(tmp_path):
    original = everything()
    save_calibration(original, tmp_path / "calibration.json")
    found = load_calibration(tmp_path / "calibration.json")
    for name in vars(original):
        if name in ("intrinsics", "response"):
            continue
        assert_same(getattr(found, name), getattr(original, name))
    assert_same(found.intrinsics.pinhole, original.intrinsics.pinhole)
    assert_same(found.intrinsics.distortion, original.intrinsics.distortion)
    assert found.intrinsics.K.tolist() == [[500.1, 0, 320.3], [0, 501.2, 240.4], [0, 0, 1]]
    assert np.array_equal(found.response.linear, original.response.linear)
    assert found.response.source == "sweep of 12 exposures"
    assert load_response(tmp_path / "calibration.json").source == "sweep of 12 exposures"
    assert found.assumptions() == []


def assert_same(found, original):
    assert np.array_equal(found.value, original.value)
    assert (found.unit, found.source) == (original.unit, original.source)
    assert (found.sigma is None) == (original.sigma is None)
    assert original.sigma is None or np.array_equal(found.sigma, original.sigma)


def test_nothing_known_is_a_calibration_that_says_what_it_assumes(tmp_path):
    found = load_calibration(tmp_path / "none.json")
    assert found.value("flash_offset_cam_m").tolist() == [0, 0, 0]
    assert found.value("flash_axis").tolist() == [0, 0, 1]
    assert found.value("flash_falloff").shape == ()
    assert found.value("flat_field").shape == (0,)
    assert np.array_equal(found.value("colour"), np.eye(3))
    assert found.value("flash_strength") is None
    sentences = found.assumptions()
    assert len(sentences) == len(set(sentences)) == 12
    assert any("at the lens" in sentence for sentence in sentences)


def test_saving_a_part_leaves_the_rest(tmp_path):
    save_calibration(everything(), tmp_path / "calibration.json")
    save_calibration(Calibration(flash_falloff=Quantity.of(2.0, "1", "again")), tmp_path / "calibration.json")
    found = load_calibration(tmp_path / "calibration.json")
    assert found.value("flash_falloff") == 2.0
    assert found.value("dark").tolist() == [0.01, 0.011, 0.012]


@pytest.mark.parametrize(
    ("quantity", "words"),
    [
        ({"dark": Quantity.of([0, 0], "1", "")}, "shape"),
        ({"dark": Quantity.of([-0.1, 0, 0], "1", "")}, "below the limit 0"),
        ({"flash_offset_cam_m": Quantity.of([1, 2, 3], "mm", "")}, "unit is 'mm'"),
        ({"flash_axis": Quantity.of([0, 0, 2], "1", "")}, "unit vector"),
        ({"intrinsics": Intrinsics(640, 480, Quantity.of([0, 1, 2, 3], "px", ""))}, "positive"),
        ({"intrinsics": Intrinsics(0, 480, Quantity.of([1, 1, 2, 3], "px", ""))}, "width"),
    ],
)
def test_impossible_values_are_neither_saved_nor_loaded(tmp_path, quantity, words):
    with pytest.raises(CalibrationError, match=words):
        save_calibration(Calibration(**quantity), tmp_path / "calibration.json")
    assert not (tmp_path / "calibration.json").exists()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda c: c.update(version=2), "newer program"),
        (lambda c: c.update(schema="x"), "schema"),
        (lambda c: c.update(flash_colour={}), "'flash_colour' is unknown"),
        (lambda c: c["dark"].update(sigma=[1]), "sigma"),
        (lambda c: c["dark"].update(sigma=-1), "sigma"),
        (lambda c: c["dark"].pop("unit"), "unit"),
        (lambda c: c["response"]["table"].update(linear=[3, 2, 1, 0]), "must not fall"),
        (lambda c: c["response"]["table"].update(linear=[[0, 0]]), "linear"),
        (lambda c: c.update(response={"transfer": "film"}), "film"),
        (lambda c: c.update(response={}), "transfer"),
    ],
)
def test_a_malformed_file_names_its_fault(tmp_path, change, words):
    path = tmp_path / "calibration.json"
    save_calibration(everything(), path)
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(CalibrationError, match=words):
        load_calibration(path)


@pytest.mark.parametrize(
    ("value", "sigma"), [([1.0, np.nan], None), ([1.0], [1.0, 2.0]), ([1.0], -1.0), (1.0, np.inf)]
)
def test_a_quantity_is_finite_with_a_fitting_sigma(value, sigma):
    with pytest.raises(ValueError, match=r"finite|shape|negative"):
        Quantity.of(value, "1", "", sigma)


@given(data=st.data())
def test_damage_is_read_or_refused(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "calibration.json"
    if not path.exists():
        save_calibration(everything(), path)
        path.with_suffix(".original").write_bytes(path.read_bytes())
    content = path.with_suffix(".original").read_bytes()
    at = data.draw(st.integers(0, len(content)))
    scrap = data.draw(st.binary(max_size=6) | st.sampled_from([b"NaN", b"null", b"[]", b"-1", b"1e999"]))
    cut = data.draw(st.booleans())
    path.write_bytes(content[:at] if cut else content[:at] + scrap + content[at + len(scrap) :])
    with contextlib.suppress(CalibrationError):
        load_calibration(path)
