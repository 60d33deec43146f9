"""Ten tasks that nobody tuned for: every controller's closed loops, over the optimum. docs/closed_loop.md explains."""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # one thread, before numpy: the same bits on every run
