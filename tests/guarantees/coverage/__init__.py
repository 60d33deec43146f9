"""Coverage on 60 random and 20 textbook plants: how many runs keep the limits that a design promises to keep, and at what cost."""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # one thread, before numpy: the same bits on every run
