"""Random sessions against the firmware's core under the address and undefined-behaviour sanitizers."""

import subprocess

import pytest


@pytest.mark.parametrize("seed", [1, 2])
def test_random_sessions_break_no_promise_and_no_memory(fuzz_build, sanitizer_environment, seed):
    """The promises are checked in C, at every edge and every byte sent; `make fuzz` runs many more."""
    with (fuzz_build / "corpus.txt").open() as corpus:
        done = subprocess.run(
            [fuzz_build / "fuzz", "3000", str(seed)],
            stdin=corpus,
            capture_output=True,
            text=True,
            check=False,
            env=sanitizer_environment,
        )
    assert done.returncode == 0, done.stderr
    words = done.stdout.split()
    counts = dict(zip(words[::2], map(int, words[1::2]), strict=True))
    # Something was tested: the corpus was there, and flashes, answers and resets happened by the thousand.
    assert counts["frames"] >= 30
    assert min(counts["flashes"], counts["answers"], counts["resets"]) > 500
