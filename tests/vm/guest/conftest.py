"""Of the tests in the machine: each is reported through the share as it begins and as it ends."""

import faulthandler
import json
import os
from pathlib import Path

import pytest

SHARE = Path("/run/machine/share")
EVENTS = SHARE / "events.jsonl"
PART = os.environ["PART"]
LIMIT_S = float(os.environ["TEST_LIMIT_S"])


def _report(**event):
    with EVENTS.open("a") as lines:
        lines.write(json.dumps({"part": PART} | event) + "\n")


def pytest_configure(config):
    config.addinivalue_line("markers", "limit_s(seconds): how long the test may take, where it is a long one")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item):
    _report(event="start", test=item.name)
    marker = item.get_closest_marker("limit_s")
    with (SHARE / "stack.log").open("w") as stack:
        faulthandler.dump_traceback_later(marker.args[0] if marker else LIMIT_S, exit=True, file=stack)
        try:
            return (yield)
        finally:
            faulthandler.cancel_dump_traceback_later()


_failed = {}


def pytest_runtest_logreport(report):
    """One line a test, when its fixtures are taken down: the worst of its three phases."""
    name = report.nodeid.rpartition("::")[2]
    outcome, detail, seconds = _failed.pop(name, ("passed", "", 0.0))
    seconds += report.duration
    if report.failed:
        outcome, detail = "failed", detail + report.longreprtext
    elif report.skipped and outcome == "passed":
        outcome, detail = "skipped", report.longrepr[2]
    if report.when == "teardown":
        _report(event="end", test=name, outcome=outcome, seconds=seconds, detail=detail)
    else:
        _failed[name] = (outcome, detail, seconds)


def pytest_collectreport(report):
    if report.failed:
        _report(event="end", test=PART, outcome="failed", seconds=0.0, detail=report.longreprtext)
