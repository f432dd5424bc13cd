"""A capture tags with the readout of its calibration, and fits it where that is of another mode."""

import json

import pytest


@pytest.mark.parametrize(("made_with", "holds"), [({}, True), ({"rate_hz": 7.0}, False)])
def test_a_calibrated_readout_is_used_where_it_holds(desk, tmp_path, made_with, holds):
    entry = {"value": 0.0187, "unit": "s", "sigma": 1e-4, "source": "test", "made_with": made_with}
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps({"schema": "relight-calibration", "version": 1, "readout_s": entry}))
    outcome = desk.capture(duration_s=4.0, calibration=path)
    light = outcome.session.info["capture"]["light"]
    assert (light["readout_s"] == 0.0187) == holds
    assert any("frames a second, not 7" in sentence for sentence in outcome.warnings) != holds
