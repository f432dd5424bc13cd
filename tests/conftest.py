"""Settings that every test shares: one thread a worker, and hypothesis without chance."""

import os

# Two workers that each start a thread per core slow each other down many times over. Set before numpy and torch
# load, which read these once.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

from hypothesis import settings

# A failure must be the same on every machine and every run; speed is measured in benchmarks, never by deadlines.
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")
