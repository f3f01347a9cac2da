"""What every test needs before numpy is imported."""

import os

# The problems are small: more threads than one are slower, and not bit for bit repeatable. The
# command and the launch file set the same.
for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
