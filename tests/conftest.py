"""Settings that every test shares: one thread a worker, and hypothesis without chance."""

import os

from hypothesis import settings

# Two workers that each start a thread per core slow each other down many times over. Set before numpy, torch
# and OpenCV load, which read these once.
for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"):
    os.environ.setdefault(variable, "1")

# A failure must be the same on every machine and every run; speed is for benchmarks, not for deadlines.
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.load_profile("fixed")
