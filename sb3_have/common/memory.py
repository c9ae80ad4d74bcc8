"""Memory allocation for training on a CPU."""

import ctypes

M_TRIM_THRESHOLD, M_MMAP_MAX = -1, -4  # malloc.h


def keep_freed_memory() -> bool:
    """
    Let glibc keep freed memory for the next allocation instead of returning it to the system.

    A training step on a CPU allocates and frees many megabytes of activations. By default glibc returns them to the
    system, which clears every page again in the next step; this can take a third of the step
    (``benchmarks.update_speed``). With this setting the process never shrinks below its peak, so a program should call
    it before training, but a library should not, and :class:`~sb3_have.HAVESAC` does not. The equivalent in a shell is
    ``MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=100000000000``.

    :return: Whether the allocator has this setting (Linux with glibc)
    """
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (AttributeError, OSError, TypeError):
        return False
    return bool(mallopt(M_MMAP_MAX, 0) and mallopt(M_TRIM_THRESHOLD, -1))
