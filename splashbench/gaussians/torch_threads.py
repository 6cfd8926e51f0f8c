"""One torch thread for fits on tensors of some ten thousand rows.

Splitting those over threads gains little on idle cores and loses a factor of four on shared ones, where OpenMP's
barriers spin; the renderer brings threads of its own. With one thread the result does not depend on the number of
cores either.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run the body with a single torch thread; the setting is restored afterwards."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
