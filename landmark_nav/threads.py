"""How many threads a process takes for linear algebra."""

import os


def keep_to_one_thread() -> None:
    """
    Take one thread where the user says nothing else; call it before NumPy is imported.

    Our matrices are small: as many threads as cores wait for each other, and `learn` takes twice
    as long. Nodes share their cores with each other besides.
    """
    for name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS'):
        os.environ.setdefault(name, '1')
