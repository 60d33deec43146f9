"""How planned experiments fare on plants that nothing was set on: what bands and limits hold, what half of the data teaches, and logs under feedback."""

import os

for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(variable, "1")  # one thread, before numpy: the same bits on every run
